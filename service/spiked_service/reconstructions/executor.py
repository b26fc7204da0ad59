"""Where jobs run: the protocol of executors, and the one that starts worker processes on this machine."""

from collections.abc import Callable
from typing import Protocol

from spiked_service.store.rows import ReconstructionRow
from spiked_service.workers.messages import JobCommand, WorkerEvent
from spiked_service.workers.process import StandbyWorker, WorkerProcess

OnEvent = Callable[[WorkerEvent], None]
OnExit = Callable[[str | None], None]
"""Called once: with None after success, otherwise with the reason as a sentence."""


class Worker(Protocol):
    """A job that an executor has started. Its events and its exit arrive on one thread."""

    @property
    def pid(self) -> int | None:
        """Process id on this machine, None elsewhere."""
        ...

    def stop(self) -> None:
        """Ask it to finish its work and exit, which may take a while."""
        ...

    def cancel(self) -> None:
        """Ask it to finish its work and exit, and end it if that takes long and it is on another machine."""
        ...

    def dismiss(self) -> None:
        """Ask it to exit at once."""
        ...

    def detach(self) -> None:
        """The service ends: a worker on this machine exits at once, others go on for its next start."""
        ...

    def kill_after(self, timeout_s: float) -> None:
        """Wait for the exit of a worker that was dismissed or detached; end it after `timeout_s`."""
        ...


class Executor(Protocol):
    """Runs jobs. The catalogue alone says which jobs there are and what has become of them."""

    def attempt(self) -> str:
        """A new id for the next start of a job; empty if jobs do not outlive the service."""
        ...

    def start(
        self,
        row: ReconstructionRow,
        command: JobCommand,
        on_event: OnEvent,
        on_exit: OnExit,
        standby: StandbyWorker | None,
    ) -> Worker:
        """Start the attempt that the row names. Raises OSError."""
        ...

    def adopt(self, row: ReconstructionRow, command: JobCommand, on_event: OnEvent, on_exit: OnExit) -> Worker:
        """Follow an attempt that was started before the service was."""
        ...

    def clean_up(self) -> None:
        """Remove what other attempts have left. Called once those of earlier services have been adopted."""
        ...


class LocalExecutor:
    """Starts worker processes of the service."""

    def attempt(self) -> str:
        """Processes end with the service."""
        return ""

    def start(
        self,
        row: ReconstructionRow,
        command: JobCommand,
        on_event: OnEvent,
        on_exit: OnExit,
        standby: StandbyWorker | None,
    ) -> Worker:
        """Start a process, or use a standby worker. Raises OSError."""
        return WorkerProcess(command, command.folder / "log", on_event, on_exit, standby)

    def adopt(self, row: ReconstructionRow, command: JobCommand, on_event: OnEvent, on_exit: OnExit) -> Worker:
        """Never called: no attempt has an id."""
        raise AssertionError("a process of the service has ended with it")

    def clean_up(self) -> None:
        """Processes of the service leave nothing elsewhere."""
