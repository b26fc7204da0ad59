"""The service's end of a worker process: starts it, sends its command, receives its events."""

import logging
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import IO, Protocol

from spiked.errors import SpikedError
from spiked_service.events.logging import logger
from spiked_service.workers.messages import STOP, Command, Logged, Role, WorkerEvent, worker_events

_log = logger("spiked.service")
_STARTUP_S = 10.0
"""Time for a standby worker that is still starting to exit."""


class Process(Protocol):
    """The process of a worker, which leads a group of its own: Ctrl-C in the terminal must reach the service only."""

    pid: int
    stdin: IO[bytes] | None
    stdout: IO[bytes] | None

    def poll(self) -> int | None:
        """The exit code; None while it runs."""
        ...

    def wait(self, timeout: float | None = None) -> int:
        """Wait for the exit code. Raises subprocess.TimeoutExpired."""
        ...

    def kill_group(self) -> None:
        """Kill it with the processes that it has started."""
        ...


class _Spawned(subprocess.Popen[bytes]):
    """A process that this one has started."""

    def kill_group(self) -> None:
        """Kill it with the processes that it has started."""
        os.killpg(self.pid, signal.SIGKILL)  # it leads its group, and was not waited for yet


def _spawn(role: Role, errors: IO[bytes]) -> Process:
    return _Spawned(
        # -P: do not import from the working directory of the service.
        [sys.executable, "-P", "-m", "spiked_service.workers", role],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=errors,
        process_group=0,
    )


class StandbyWorker:
    """A worker process that has imported the modules of its role and waits for a command."""

    def __init__(self, role: Role, log: Path, start: Callable[[Role, IO[bytes]], Process] = _spawn) -> None:
        """`start` gets the role and the file for errors. Raises OSError."""
        self.role = role
        self.log = log
        with log.open("ab") as errors:
            self.process = start(role, errors)

    def dismiss(self) -> None:
        """Close its pipes, so that it exits."""
        assert self.process.stdin is not None and self.process.stdout is not None
        try:
            self.process.stdin.close()
        except BrokenPipeError:
            pass  # it was killed
        finally:
            self.process.stdout.close()
        threading.Thread(
            target=self.kill_after, args=(_STARTUP_S,), name=f"end of standby {self.role}", daemon=True
        ).start()

    def kill_after(self, timeout_s: float) -> None:
        """Wait for it to exit; kill it after `timeout_s`."""
        _wait_or_kill(self.process, timeout_s)


class WorkerProcess:
    """A running worker.

    The worker exits when its stdin closes, so it never outlives the service. Callbacks for events and for the exit are
    called on a thread of this object.
    """

    def __init__(
        self,
        command: Command,
        log: Path,
        on_event: Callable[[WorkerEvent], None],
        on_exit: Callable[[str | None], None],
        standby: StandbyWorker | None = None,
    ) -> None:
        """Start a process, or use a standby worker of the role.

        `on_exit` is called with None after a successful exit, otherwise with the reason as a sentence.
        """
        self.role: Role = command.role
        self._on_event = on_event
        self._on_exit = on_exit
        self._writing = threading.Lock()
        worker = standby if standby is not None and standby.process.poll() is None else StandbyWorker(command.role, log)
        self._log = worker.log
        self._process = worker.process
        assert self._process.stdin is not None and self._process.stdout is not None
        self._stdin: IO[bytes] = self._process.stdin
        self._stdout: IO[bytes] = self._process.stdout
        self._send(command.model_dump_json() + "\n")
        self._listener = threading.Thread(target=self._listen, name=f"events of {self.role}", daemon=True)
        self._listener.start()

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    def stop(self) -> None:
        """Ask it to finish its work and exit, which may take a while."""
        self._send(STOP)

    def cancel(self) -> None:
        """Ask it to finish its work and exit, as nobody waits for it."""
        self.stop()

    def dismiss(self) -> None:
        """Ask it to exit at once."""
        with self._writing:
            try:
                self._stdin.close()
            except BrokenPipeError:
                return  # it has exited already

    def detach(self) -> None:
        """The service ends, and with it its workers."""
        self.dismiss()

    def kill_after(self, timeout_s: float) -> None:
        """Wait for it to exit; kill it after `timeout_s`, with the processes that it has started."""
        _wait_or_kill(self._process, timeout_s)
        self._listener.join()

    def _send(self, line: str) -> None:
        with self._writing:
            try:
                self._stdin.write(line.encode())
                self._stdin.flush()
            except (BrokenPipeError, ValueError):
                return  # it has exited, which on_exit reports

    def _listen(self) -> None:
        failure = None
        with self._stdout:
            for line in self._stdout:
                if not line.endswith(b"\n"):
                    break  # it was killed in the middle of a line
                try:
                    self._take(line)
                except Exception as error:  # on_exit must be called whatever fails here
                    _log.exception("event not processed", role=str(self.role))
                    failure = failure or f"an event of the {self.role} worker could not be processed: {_reason(error)}"
                    self.dismiss()
        code = self._process.wait()
        # Closing flushes bytes that a dead worker did not read; the error must not prevent on_exit.
        with self._writing, suppress(BrokenPipeError):
            self._stdin.close()
        self._on_exit(failure or self._exit_reason(code))

    def _take(self, line: bytes) -> None:
        event = worker_events.validate_json(line)
        if isinstance(event, Logged):
            relay(event)
        else:
            self._on_event(event)

    def _exit_reason(self, code: int) -> str | None:
        if code == 0:
            return None
        if code < 0:
            return f"the {self.role} worker was killed by signal {-code}"
        return f"the {self.role} worker failed unexpectedly; see {self._log}"


def _reason(error: Exception) -> str:
    """For users: without the name of the exception, which is in the log."""
    if isinstance(error, SpikedError):
        return str(error)
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return "see the log of the service"


def _wait_or_kill(process: Process, timeout_s: float) -> None:
    try:
        process.wait(timeout_s)
    except subprocess.TimeoutExpired:
        process.kill_group()
        process.wait()


def relay(line: Logged) -> None:
    """Log a worker's line in this process."""
    level = logging.getLevelNamesMapping().get(line.level.upper(), logging.WARNING)
    logger(line.logger, **line.known).log(level, line.event)
