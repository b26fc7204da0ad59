"""Removes captures: marked as deleted first, then for good."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from typing import Protocol

from spiked_service.base.errors import BusyError
from spiked_service.reconstructions.queue import Reconstructions
from spiked_service.store.catalogue import Catalogue
from spiked_service.store.folder import DataFolder
from spiked_service.store.rows import CaptureRow, JobState
from spiked_service.store.snapshot import Snapshot

_AT_ONCE = 256
"""Reconstructions whose ids are read at once."""


class Rows(Protocol):
    """The captures as they are now."""

    def get(self, capture_id: str) -> Snapshot:
        """Raises UnknownIdError."""
        ...

    def change(self, capture_id: str, **fields: object) -> Snapshot:
        """Change fields and publish. Raises UnknownIdError, BusyError."""
        ...

    def forget(self, capture_id: str) -> None:
        """It is deleted for good."""
        ...


class Removal:
    """Thread-safe. Nobody changes a capture, or restores it, while its files are being deleted."""

    def __init__(self, folder: DataFolder, catalogue: Catalogue, reconstructions: Reconstructions, rows: Rows) -> None:
        self._folder = folder
        self._catalogue = catalogue
        self._reconstructions = reconstructions
        self._rows = rows
        self._lock = threading.Lock()
        self._going: set[str] = set()

    def remove(self, capture_id: str) -> Snapshot:
        """Mark a capture as deleted, until `restore` or `purge`. Raises UnknownIdError, BusyError."""
        at = self._ended(capture_id).row.deleted_at or datetime.now(UTC)
        removed = self._catalogue.freeing(self._rows.change, capture_id, deleted_at=at)
        self._catalogue.freeing(self._reconstructions.cancel_all_of, capture_id)
        return removed

    def restore(self, capture_id: str) -> Snapshot:
        """Undo `remove`. Raises UnknownIdError, BusyError."""
        return self._rows.change(capture_id, deleted_at=None)

    def purge(self, capture_id: str, still: Callable[[CaptureRow], bool] = lambda row: True) -> None:
        """Delete a capture with its files and reconstructions, for good, if its row is `still` one to delete.

        Raises UnknownIdError, and BusyError, and then nothing is deleted.
        """
        with self._lock:
            self._check_purge(capture_id, still)
            self._going.add(capture_id)
        try:
            while ids := self._catalogue.job_ids(capture_id, _AT_ONCE):
                for row_id in ids:
                    self._catalogue.freeing(self._reconstructions.remove, row_id)
            self._folder.remove(self._folder.capture(capture_id))
            self._catalogue.freeing(self._catalogue.captures.remove, capture_id)
            self._rows.forget(capture_id)
        finally:
            with self._lock:
                self._going.discard(capture_id)

    @contextmanager
    def no_purge(self, capture_id: str) -> Iterator[None]:
        """For a change of a row: no deletion begins meanwhile. Raises BusyError during one."""
        with self._lock:
            self._check_going(capture_id)
            yield

    def _check_purge(self, capture_id: str, still: Callable[[CaptureRow], bool]) -> None:
        self._check_going(capture_id)
        now = self._ended(capture_id)
        if self._catalogue.job_counts(capture_id)[JobState.RUNNING]:
            raise BusyError(f"a reconstruction of capture {capture_id} is running: cancel it first")
        if not still(now.row):
            raise BusyError(f"capture {capture_id} has been restored or kept")

    def _check_going(self, capture_id: str) -> None:
        if capture_id in self._going:
            raise BusyError(f"capture {capture_id} is being deleted for good")

    def _ended(self, capture_id: str) -> Snapshot:
        snapshot = self._rows.get(capture_id)
        if not snapshot.row.state.over:
            raise BusyError(f"capture {capture_id} is still {snapshot.row.state}: stop it first")
        return snapshot
