"""Retention: removes old captures so that the disk does not fill."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Protocol

from spiked_service.base.errors import BusyError
from spiked_service.store.catalogue import Catalogue
from spiked_service.store.disk_use import DiskUse
from spiked_service.store.folder import UPLOAD_SUFFIXES, DataFolder
from spiked_service.store.rows import CaptureRow

_UPLOAD_DAYS = 1.0
"""Uploads without progress for this time are removed."""


@dataclass(frozen=True)
class Policy:
    """Limits; None: unlimited."""

    days: float | None = None
    """Captures older than this are marked as deleted."""
    bytes: int | None = None
    """Most bytes of captures and reconstructions; above it the oldest are purged, deleted ones first."""
    deleted_days: float = 7.0
    """Deleted captures are purged after this time."""


class Removing(Protocol):
    """Operations that retention needs."""

    def remove(self, capture_id: str) -> object:
        """Mark it as deleted."""
        ...

    def purge(self, capture_id: str, still: Callable[[CaptureRow], bool]) -> None:
        """Purge it, if its row is `still` one to purge. Raises BusyError."""
        ...


class Retention:
    """Applies a policy. Captures that are kept or running are exempt unless a user deleted them."""

    def __init__(
        self, folder: DataFolder, catalogue: Catalogue, captures: Removing, log: Callable[[str], None]
    ) -> None:
        self._folder = folder
        self._catalogue = catalogue
        self._captures = captures
        self._log = log
        self.disk_use = DiskUse(folder, catalogue)
        self.policy = Policy()
        """May be changed at any time."""

    def apply(self, now: datetime | None = None) -> None:
        """Remove what exceeds the policy, but for captures with a running job. Raises StoreError."""
        now = now or datetime.now(UTC)
        policy = self.policy
        kept = timedelta(days=policy.deleted_days)
        for row in self._older("deleted = 1", now, kept):
            if row.deleted_at is not None and now - row.deleted_at >= kept:
                self._purge(row, f"it was removed {policy.deleted_days:g} days ago", removed=True)
        if policy.days is not None:
            kept = timedelta(days=policy.days)
            for row in self._older("deleted = 0 AND keep = 0", now, kept):
                if _disposable(row) and now - (row.ended_at or row.started_at) > kept:
                    self._captures.remove(row.id)
                    self._log(f"capture {row.id} was removed: it is older than {policy.days:g} days")
        self._shrink(policy.bytes)
        self._drop_uploads(now)

    def _older(self, condition: str, now: datetime, age: timedelta) -> Iterator[CaptureRow]:
        """Captures that have been over, or removed, for that time or nearly so, the oldest first."""
        query = f"SELECT id FROM capture_list WHERE {condition} AND since <= ? ORDER BY since"
        yield from self._over(self._catalogue.read(query, (int(now.timestamp() - age.total_seconds()),)))

    def _over(self, ids: Iterable[tuple[str]]) -> Iterator[CaptureRow]:
        rows = (self._catalogue.captures.find(row_id) for (row_id,) in ids)
        return (row for row in rows if row is not None and row.state.over)

    def _shrink(self, limit: int | None) -> None:
        if limit is None:
            self.disk_use.forget()
            return
        used = self.disk_use.by_capture()
        total = sum(used.values())
        if total <= limit:
            return
        why = f"all captures together are larger than {limit} bytes"
        kinds = {True: "deleted = 1", False: "deleted = 0 AND keep = 0"}
        listed = {
            removed: self._catalogue.read(f"SELECT id FROM capture_list WHERE {condition} ORDER BY id")
            for removed, condition in kinds.items()
        }
        for removed, ids in listed.items():
            for row in self._over(ids):
                if total <= limit:
                    return
                if self._purge(row, why, removed=removed):
                    total -= used.get(row.id, 0)

    def _purge(self, row: CaptureRow, why: str, *, removed: bool) -> bool:
        """Purge one that is `removed`, or not; not if that or `keep` has changed, or a job runs. Whether it was."""
        try:
            self._captures.purge(row.id, lambda now: now.deleted_at is not None if removed else _disposable(now))
        except BusyError:
            return False  # the next time
        self._log(f"capture {row.id} is gone: {why}")
        return True

    def _drop_uploads(self, now: datetime) -> None:
        for row in self._catalogue.uploads.where():
            if row.capture_id is not None or now - row.updated_at > timedelta(days=_UPLOAD_DAYS):
                for suffix in UPLOAD_SUFFIXES:
                    self._folder.upload(row.id).with_suffix(suffix).unlink(missing_ok=True)
                self._catalogue.uploads.remove(row.id)


def _disposable(row: CaptureRow) -> bool:
    return not row.keep and row.deleted_at is None
