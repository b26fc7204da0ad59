"""Retention: removes old captures so that the disk does not fill."""

from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Protocol

from spiked_service.base.errors import BusyError
from spiked_service.store.catalogue import Catalogue
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
        self.policy = Policy()
        """May be changed at any time."""

    def apply(self, now: datetime | None = None) -> None:
        """Remove what exceeds the policy, but for captures with a running job. Raises StoreError."""
        now = now or datetime.now(UTC)
        policy = self.policy
        rows = [row for row in self._catalogue.captures.where("1 ORDER BY id") if row.state.over]
        for row in rows:
            if row.deleted_at is not None and now - row.deleted_at >= timedelta(days=policy.deleted_days):
                self._purge(row, f"it was removed {policy.deleted_days:g} days ago")
            elif policy.days is not None and _disposable(row) and _age(row, now) > timedelta(days=policy.days):
                self._captures.remove(row.id)
                self._log(f"capture {row.id} was removed: it is older than {policy.days:g} days")
        self._shrink(policy.bytes)
        self._drop_uploads(now)

    def used_bytes(self) -> dict[str, int]:
        """Bytes on disk by capture, with its reconstructions."""
        used = {row.id: _size(self._folder.capture(row.id)) for row in self._catalogue.captures.where()}
        for row_id, capture_id in self._catalogue.read("SELECT id, capture_id FROM jobs"):
            used[capture_id] = used.get(capture_id, 0) + _size(self._folder.reconstruction(row_id))
        return used

    def _shrink(self, limit: int | None) -> None:
        if limit is None:
            return
        used = self.used_bytes()
        total = sum(used.values())
        rows = [row for row in self._catalogue.captures.where("1 ORDER BY id") if row.state.over]
        candidates = [row for row in rows if row.deleted_at] + [row for row in rows if _disposable(row)]
        for row in candidates:
            if total <= limit:
                return
            if self._purge(row, f"all captures together are larger than {limit} bytes"):
                total -= used.get(row.id, 0)

    def _purge(self, row: CaptureRow, why: str) -> bool:
        """Purge a capture, unless it was restored or kept meanwhile, or one of its jobs runs; whether it was."""
        removed = row.deleted_at is not None
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


def _age(row: CaptureRow, now: datetime) -> timedelta:
    return now - (row.ended_at or row.started_at)


def _size(folder: Path) -> int:
    """Bytes that the files below a folder occupy."""
    total = 0
    for path in folder.rglob("*"):
        try:
            stat = path.lstat()
            total += stat.st_blocks * 512 // stat.st_nlink  # a job links the maps that it uses
        except FileNotFoundError:
            continue  # a running reconstruction lets go of versions
    return total
