"""The row of a running capture: each change is saved and published."""

import threading
from collections.abc import Callable, Mapping
from dataclasses import replace

from spiked_service.captures.states import CaptureEvent, next_state
from spiked_service.reconstructions.notifier import Notifier
from spiked_service.store.catalogue import Catalogue, StoreError
from spiked_service.store.rows import CaptureRow


class LiveRow:
    """A catalogue row that is changed while its capture runs. Thread-safe.

    A change that cannot be saved is logged and kept in memory, until `save` succeeds.
    """

    def __init__(
        self, row: CaptureRow, catalogue: Catalogue, notifier: Notifier, on_change: Callable[[], None]
    ) -> None:
        """`on_change` is called after each change, possibly with locks of the capture held."""
        self._row = row
        self._catalogue = catalogue
        self._notifier = notifier
        self._on_change = on_change
        self._failed = False
        self._lock = threading.RLock()

    @property
    def now(self) -> CaptureRow:
        """The current row."""
        return self._row

    @property
    def failed(self) -> bool:
        """Whether an error has ended the capture early."""
        return self._failed

    def set(self, **fields: object) -> None:
        """Change fields other than the state."""
        with self._lock:
            self._store(fields)
        self._on_change()

    def apply(self, event: CaptureEvent, **fields: object) -> None:
        """Change the state after an event, and further fields with it."""
        with self._lock:
            state = next_state(self._row.state, event)
            if state is self._row.state and not fields:
                return
            self._store({"state": state, **fields})
        self._on_change()

    def edit(self, **fields: object) -> None:
        """Change what a user may change. Raises StoreError if it cannot be saved."""
        with self._lock:
            edited = replace(self._row, **fields)  # type: ignore[arg-type]
            self._catalogue.captures.put(edited)
            self._row = edited
        self._on_change()

    def warn(self, *texts: str) -> None:
        """Append warnings, if there are any."""
        if texts:
            with self._lock:
                self._store({"warnings": (*self._row.warnings, *texts)})
            self._on_change()

    def fail(self, reason: str) -> None:
        """Mark the capture as failed. The first error becomes its reason."""
        self._notifier.log("error", reason, self._row.id)
        with self._lock:
            self._failed = True
            if self._row.reason:
                return
            self._store({"reason": reason})
        self._on_change()

    def save(self) -> bool:
        """Save the row. Return whether that succeeded."""
        try:
            self._catalogue.captures.put(self._row)
        except StoreError as error:
            self._notifier.log("error", str(error), self._row.id)
            return False
        return True

    def _store(self, fields: Mapping[str, object]) -> None:
        self._row = replace(self._row, **fields)  # type: ignore[arg-type]
        self.save()
