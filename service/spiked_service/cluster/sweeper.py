"""Removes what attempts that are over have left in the object store."""

import threading
import time
from collections.abc import Callable

from spiked.errors import SpikedError
from spiked_service.base.ids import is_id
from spiked_service.cluster.object_store import ObjectStore
from spiked_service.cluster.shared_recordings import SharedRecordings
from spiked_service.events.logging import logger

_log = logger("spiked.cluster")
_SWEEP_S = 600.0
"""Interval of sweeps: a machine that was asleep may store something long after its attempt has been fenced off."""
_AGAIN_S = 20.0
"""Pause after a sweep that has failed, because the store did not answer."""


class Sweeper:
    """Sweeps the store of a service on a thread of its own: at the start, when an attempt has ended, and at times.

    The ids of attempts are never used again, and an attempt is known to be alive before it stores anything: what is
    listed first and found not to be alive afterwards is over for good.
    """

    def __init__(self, store: ObjectStore, alive: Callable[[str], bool], recordings: SharedRecordings) -> None:
        """`store` has a folder for each job and in it one for each attempt; `alive` takes the id of an attempt."""
        self._store = store
        self._recordings = recordings
        self._alive = alive
        self._wake = threading.Condition()
        self._wanted = True
        self._closed = False
        self._uploads_s: float | None = None
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Sweep from now on: the attempts of earlier services are known."""
        with self._wake:
            if self._thread is None and not self._closed:
                self._thread = threading.Thread(target=self._run, name="sweeper", daemon=True)
                self._thread.start()

    def wake(self) -> None:
        """Sweep soon."""
        with self._wake:
            self._wanted = True
            self._wake.notify_all()

    def close(self) -> None:
        """Sweep no more."""
        with self._wake:
            self._closed = True
            self._wake.notify_all()

    def sweep(self) -> int:
        """Remove the objects of attempts that are over, and recordings that none reads. Raises ObjectStoreError.

        Returns of how many attempts.
        """
        swept = 0
        for job in filter(is_id, self._store.folders()):
            for attempt in filter(is_id, self._store.below(job).folders()):
                if self._closed:
                    return swept
                if not self._alive(attempt):
                    self._store.below(job, attempt).remove()
                    swept += 1
        self._recordings.sweep()
        if self._uploads_s is None or time.monotonic() - self._uploads_s > _SWEEP_S:
            self._store.end_uploads(self._is_over)
            self._recordings.store.end_uploads(self._recordings.is_left)
            self._uploads_s = time.monotonic()
        return swept

    def _is_over(self, name: str) -> bool:
        """Whether an object belongs to an attempt that is over."""
        job, attempt, *_ = (*name.split("/"), "")
        return is_id(job) and is_id(attempt) and not self._alive(attempt)

    def _run(self) -> None:
        pause_s = _SWEEP_S
        while True:
            with self._wake:
                if not (self._wanted or self._closed):
                    self._wake.wait(pause_s)
                if self._closed:
                    return
                self._wanted = False
            try:
                swept = self.sweep()
            except SpikedError as error:
                _log.warning("store not swept", reason=str(error), again_s=_AGAIN_S)
                pause_s = _AGAIN_S
                continue
            pause_s = _SWEEP_S
            if swept:
                _log.info("store swept", attempts=swept)
