"""Runs the worker of one role and starts it again when it died; shared by acquisition, preview and recorder."""

import threading
from collections.abc import Callable
from pathlib import Path

from spiked_service.events.logging import logger
from spiked_service.workers.backoff import Backoff
from spiked_service.workers.messages import Command, Role, WorkerEvent
from spiked_service.workers.process import StandbyWorker, WorkerProcess

_log = logger("spiked.service")


class WorkerSupervisor:
    """Runs at most one worker process at a time. Thread-safe.

    `start` runs the worker. After its exit `on_exit` is called, with None after a successful exit, otherwise with the
    reason as a sentence. The owner then either calls `restart`, which may give up, or leaves the worker ended.
    `cancel` and `dismiss` rule out further starts. `on_event` and `on_exit` are called without a lock held.
    """

    def __init__(
        self,
        role: Role,
        log: Path,
        on_event: Callable[[WorkerEvent], None],
        on_exit: Callable[[str | None], None],
        keep_standby: bool = False,
    ) -> None:
        """With `keep_standby`, a second process has loaded the role and takes over within milliseconds."""
        self._role = role
        self._file = log
        self._on_event = on_event
        self._on_exit = on_exit
        self._keep_standby = keep_standby
        self._lock = threading.RLock()
        self._backoff = Backoff()
        self._command: Command | None = None
        self._worker: WorkerProcess | None = None  # the last one, also after its exit
        self._running = False
        self._timer: threading.Timer | None = None
        self._standby: StandbyWorker | None = None
        self._cancelled = False

    @property
    def pid(self) -> int | None:
        """Process id of the running worker; None while none runs."""
        with self._lock:
            return self._worker.pid if self._running and self._worker is not None else None

    @property
    def running(self) -> bool:
        """Whether a worker runs; false while it waits for its restart."""
        return self._running

    def start(self, command: Command, standby: StandbyWorker | None = None) -> None:
        """Start the worker, from a standby worker if one is given. Does nothing after `cancel`. Raises OSError."""
        with self._lock:
            if self._cancelled:
                return
            self._command = command
            self._worker = WorkerProcess(command, self._file, self._on_event, self._exited, standby)
            self._running = True
            if self._keep_standby:
                self._standby = self._another_standby()

    def restart(self, command: Command | None = None) -> bool:
        """Start an ended worker again after the next delay, with its last command if none is given.

        Return false after the last delay, and after `cancel`.
        """
        with self._lock:
            command = command or self._command
            assert command is not None, "it was started before"
            delay_s = self._backoff.delay_s()
            if delay_s is None or self._cancelled:
                return False
            self._timer = threading.Timer(delay_s, self._start_again, (command,))
            self._timer.daemon = True
            self._timer.start()
            return True

    def stop(self) -> None:
        """Ask the running worker to finish its work and exit."""
        with self._lock:
            worker = self._worker if self._running else None
        if worker is not None:
            worker.stop()

    def cancel(self) -> bool:
        """Rule out further starts. Return whether a restart was pending."""
        with self._lock:
            pending, standby = self._timer, self._standby
            self._cancelled, self._timer, self._standby = True, None, None
        if pending is not None:
            pending.cancel()
        if standby is not None:
            standby.dismiss()
        return pending is not None

    def dismiss(self) -> bool:
        """Ask the worker to exit at once and rule out further starts. Return whether a restart was pending."""
        pending = self.cancel()
        if self._worker is not None:
            self._worker.dismiss()
        return pending

    def join(self, timeout_s: float) -> None:
        """Wait for a dismissed worker and for `on_exit`; kill the worker after `timeout_s`."""
        if self._worker is not None:
            self._worker.kill_after(timeout_s)

    def _exited(self, trouble: str | None) -> None:
        with self._lock:
            self._running = False
        self._on_exit(trouble)

    def _start_again(self, command: Command) -> None:
        with self._lock:
            self._timer = None
            standby, self._standby = self._standby, None
            try:
                self.start(command, standby)
                return
            except OSError as error:
                trouble = f"the {self._role} worker cannot be started again: {error.strerror}"
                if self.restart(command):
                    _log.warning("worker not restarted", role=str(self._role), reason=error.strerror)
                    return
        self._on_exit(trouble)

    def _another_standby(self) -> StandbyWorker | None:
        """None if there are no resources for it: the worker runs without, and its restart takes longer."""
        try:
            return StandbyWorker(self._role, self._file)
        except OSError as error:
            _log.warning("no standby worker", role=str(self._role), reason=error.strerror)
            return None
