"""The queue as clients see it: places and times of jobs, and what they are told when these change."""

import threading
import time
from collections.abc import Mapping, Sequence

from spiked_service.reconstructions.notifier import Notifier
from spiked_service.reconstructions.queue_estimates import FRONT, Front, QueueEstimates
from spiked_service.reconstructions.queue_order import QueueOrder
from spiked_service.reconstructions.queue_policy import QueuePolicy
from spiked_service.store.catalogue import Catalogue, StoreError
from spiked_service.store.rows import JobState, ReconstructionRow

_FRESH_S = 1.0
"""Age up to which times are not estimated again; places are always those of now."""
_TELL_S = 0.25
"""Least time between two accounts of changed places: a change at the front moves all of its jobs."""


class QueueView:
    """Places and times of queued jobs. The lock is that of the rows; methods take it.

    A row that has changed is published at once. The others of the front, whose places or times change with it, are
    published by a thread, for all changes of a while together: so many changes cost little more than one.
    """

    def __init__(
        self,
        catalogue: Catalogue,
        notifier: Notifier,
        policy: QueuePolicy,
        running: Mapping[str, ReconstructionRow],
        lock: threading.RLock,
    ) -> None:
        """`running` has the rows with a worker, by id, at any time."""
        self.order = QueueOrder(catalogue)
        self._estimates = QueueEstimates(catalogue, self.order)
        self._notifier = notifier
        self._policy = policy
        self._running = running
        self._lock = lock
        self._front: Front | None = None
        self._estimated_s = 0.0
        self._changed = threading.Event()
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None

    def placed(
        self, rows: Sequence[ReconstructionRow], places: Mapping[str, int] | None = None
    ) -> list[ReconstructionRow]:
        """Rows with place and time where they are queued, the others as they are; `places` if they are known.

        Raises StoreError.
        """
        queued = [row.id for row in rows if row.state is JobState.QUEUED]
        if not queued:
            return list(rows)
        with self._lock:
            front, places = self._estimated(), self.order.places(queued) if places is None else places
            return [front.placed(row, places[row.id]) if row.id in places else row for row in rows]

    def tell(self, row: ReconstructionRow, *, ran: bool) -> None:
        """Publish a row that has changed, with its place if it is queued; `ran`: it had a worker until now."""
        with self._lock:
            try:
                if ran or row.state in (JobState.RUNNING, JobState.COMPLETE) or self._is_near(row.id):
                    self._front = None
                    self._tell_others()
                (row,) = self.placed([row])
                self._estimates.told(row)
            except StoreError as error:
                self._notifier.log("error", str(error))
            self._notifier.job(row)

    def forget(self, reconstruction_id: str) -> None:
        """A reconstruction was deleted. Raises StoreError."""
        with self._lock:
            if self._front is not None and reconstruction_id in self._front.by_id:
                self._front = None
                self._tell_others()

    def close(self) -> None:
        """End the thread."""
        self._closing.set()
        self._changed.set()
        if self._thread is not None:
            self._thread.join()

    def _is_near(self, reconstruction_id: str) -> bool:
        """Whether it was or is at the front."""
        if self._front is None or reconstruction_id in self._front.by_id:
            return True
        return self.order.places([reconstruction_id]).get(reconstruction_id, FRONT + 1) <= FRONT

    def _estimated(self) -> Front:
        """The front of the queue, with places and times."""
        now_s = time.monotonic()
        if self._front is None or now_s - self._estimated_s > _FRESH_S:
            self._front = self._estimates.front([*self._running.values()], self._policy.limit)
            self._estimated_s = now_s
        return self._front

    def _tell_others(self) -> None:
        self._changed.set()
        if self._thread is None and not self._closing.is_set():
            self._thread = threading.Thread(target=self._follow, name="queue places", daemon=True)
            self._thread.start()

    def _follow(self) -> None:
        while True:
            self._changed.wait()
            if self._closing.is_set():
                return
            self._changed.clear()
            try:
                with self._lock:
                    for row in self._estimates.changed(self._estimated()):
                        self._notifier.job(row)
            except StoreError as error:
                self._notifier.log("error", str(error))
            self._closing.wait(_TELL_S)
