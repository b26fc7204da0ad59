"""Which queued jobs can begin, and what becomes of those whose capture was removed."""

from collections.abc import Callable, Iterator

from spiked_service.reconstructions.interruption import failed
from spiked_service.reconstructions.queue_policy import QueuePolicy
from spiked_service.reconstructions.repository import ReconstructionRepository
from spiked_service.store.catalogue import Catalogue
from spiked_service.store.rows import CaptureRow, JobState, ReconstructionRow

_AT_ONCE = 16
"""Waiting jobs of a removed capture that are cancelled at a time: some 10 ms, for which others wait."""


class ReadyJobs:
    """Reads the queue under the lock of its owner. Not thread-safe.

    A capture can have very many jobs: those of a removed one never begin, and are cancelled few at a time; those that
    wait for the end of one are passed over without being read.
    """

    def __init__(
        self,
        catalogue: Catalogue,
        rows: ReconstructionRepository,
        policy: QueuePolicy,
        cancel: Callable[[str], object],
    ) -> None:
        self._catalogue = catalogue
        self._rows = rows
        self._policy = policy
        self._cancel = cancel
        self._removed: set[str] = set()
        """Removed captures whose waiting jobs are being cancelled."""

    def __iter__(self) -> Iterator[tuple[ReconstructionRow, CaptureRow]]:
        """Jobs that can begin, the next one first; jobs without a recording fail. Raises StoreError."""
        passed = set(self._removed)
        for row in self._rows.queued(passed):
            if not self._policy.due(row.id):
                continue
            capture = self._catalogue.captures.find(row.capture_id)
            recorded = capture is not None and capture.recording is not None and capture.recording.frames > 0
            ready = recorded or not row.task.reads_recording
            if capture is not None and capture.deleted_at is not None:
                self._removed.add(capture.id)
            elif capture is None or (capture.state.over and not ready):
                self._rows.save(failed(row, row.reason or "the capture has no recording"))
            elif ready:
                yield row, capture
            else:
                passed.add(capture.id)

    def find_removed(self) -> None:
        """Go on with the captures that were removed before the service was started. Raises StoreError."""
        self._removed |= set(self._catalogue.captures_to_clear())

    def remove(self, capture_id: str) -> None:
        """A capture was removed. Raises StoreError."""
        self._removed.add(capture_id)
        self.cancel_some()

    def cancel_some(self) -> bool:
        """Cancel some jobs of removed captures; whether more are left. Raises StoreError."""
        for capture_id in list(self._removed)[:1]:
            ids = self._catalogue.job_ids(capture_id, _AT_ONCE, JobState.QUEUED)
            capture = self._catalogue.captures.find(capture_id)
            if not ids or (capture is not None and capture.deleted_at is None):
                self._removed.discard(capture_id)
            else:
                for row_id in ids:
                    self._cancel(row_id)
        return bool(self._removed)
