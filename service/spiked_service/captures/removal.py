"""Removes captures: marked as deleted first, then for good."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from typing import Protocol

from spiked_service.base.errors import BusyError
from spiked_service.captures.purging import Purging
from spiked_service.reconstructions.queue import Reconstructions
from spiked_service.store.catalogue import Catalogue
from spiked_service.store.rows import CaptureRow
from spiked_service.store.snapshot import Snapshot


class Rows(Protocol):
    """The captures as they are now."""

    def get(self, capture_id: str) -> Snapshot:
        """Raises UnknownIdError."""
        ...

    def change(self, capture_id: str, **fields: object) -> Snapshot:
        """Change fields and publish. Raises UnknownIdError."""
        ...

    def forget(self, capture_id: str) -> None:
        """It is deleted for good."""
        ...


class Removal:
    """Thread-safe. Nobody changes a capture, or restores it, while its purge begins."""

    def __init__(self, catalogue: Catalogue, reconstructions: Reconstructions, purging: Purging, rows: Rows) -> None:
        self._catalogue = catalogue
        self._reconstructions = reconstructions
        self._purging = purging
        self._rows = rows
        self._lock = threading.Lock()

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
        """Delete a capture with its reconstructions, for good, if its row is `still` one to delete.

        They are gone at once, their files soon. Raises UnknownIdError, StoreError, and BusyError, and then nothing is
        deleted.
        """

        def begin() -> None:
            if not still(self._ended(capture_id).row):
                raise BusyError(f"capture {capture_id} has been restored or kept")
            self._purging.begin(capture_id)

        with self._lock:
            self._reconstructions.while_idle(capture_id, begin)
        self._rows.forget(capture_id)

    @contextmanager
    def no_purge(self) -> Iterator[None]:
        """For a change of a row: no purge begins meanwhile."""
        with self._lock:
            yield

    def _ended(self, capture_id: str) -> Snapshot:
        snapshot = self._rows.get(capture_id)
        if not snapshot.row.state.over:
            raise BusyError(f"capture {capture_id} is still {snapshot.row.state}: stop it first")
        return snapshot
