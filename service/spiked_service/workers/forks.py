"""Workers forked from a process that has imported the modules of their role, so that each starts in milliseconds."""

import errno
import json
import os
import queue
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

from spiked_service.workers.fork_server import FORK, FORKS, KILL, LONGEST
from spiked_service.workers.messages import Role
from spiked_service.workers.process import StandbyWorker

_CLOSING_S = 10.0
"""Time for a server to exit that is still importing."""
_STDERR = 2
"""Where a server prints what libraries print while they are imported."""


class ForkedWorkers:
    """Forks workers of one role. Its server is started when it is needed, again if it has died. Thread-safe."""

    def __init__(self, role: Role) -> None:
        self._role = role
        self._lock = threading.Lock()
        self._server: _Server | None = None

    def standby(self, log: Path) -> StandbyWorker:
        """A worker that waits for its command and writes its errors to `log`. Raises OSError.

        Blocks while a new server imports the modules of the role.
        """
        with self._lock:
            if self._server is None or self._server.ended:
                self._server = _Server(self._role)
            server = self._server
        return StandbyWorker(self._role, log, lambda _, errors: server.fork(errors))

    def close(self) -> None:
        """End the server, and with it workers that still run."""
        with self._lock:
            server, self._server = self._server, None
        if server is not None:
            server.close()


class ForkedProcess:
    """A forked worker, as `subprocess.Popen` has it."""

    def __init__(self, kill: Callable[[int], None], stdin: IO[bytes], stdout: IO[bytes]) -> None:
        self.pid = 0
        """0 until it is there."""
        self.stdin: IO[bytes] | None = stdin
        self.stdout: IO[bytes] | None = stdout
        self._kill = kill
        self._code: int | None = None
        self._over = threading.Event()

    def end(self, code: int) -> None:
        """It has ended with this exit code."""
        self._code = code
        self._over.set()

    def poll(self) -> int | None:
        """The exit code; None while it runs."""
        return self._code

    def wait(self, timeout: float | None = None) -> int:
        """Wait for the exit code. Raises subprocess.TimeoutExpired."""
        if not self._over.wait(timeout):
            raise subprocess.TimeoutExpired(f"worker {self.pid}", timeout or 0.0)
        assert self._code is not None
        return self._code

    def kill_group(self) -> None:
        """Kill it with the processes that it has started."""
        self._kill(self.pid)


class _Server:
    """One process that forks. Its workers die with it."""

    def __init__(self, role: Role) -> None:
        """Raises OSError."""
        self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.ended = False
        """Whether it can fork no more."""
        self._asking = threading.Lock()
        self._asked: ForkedProcess | None = None
        self._answers: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._workers: dict[int, ForkedProcess] = {}
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "spiked_service.workers", role, FORKS],
                stdin=theirs.fileno(),
                stdout=_STDERR,
                process_group=0,
            )
        threading.Thread(target=self._listen, name=f"forks of {role}", daemon=True).start()

    def fork(self, errors: IO[bytes]) -> ForkedProcess:
        """A worker that writes its errors to the file. Raises OSError."""
        stdin, writes = os.pipe()
        reads, stdout = os.pipe()
        to_worker, from_worker = os.fdopen(writes, "wb"), os.fdopen(reads, "rb")
        worker = ForkedProcess(self._kill, to_worker, from_worker)
        try:
            with self._asking:
                self._asked = worker
                socket.send_fds(self._socket, [FORK], [stdin, stdout, errors.fileno()])
                refused = self._answers.get()
        except OSError as error:
            refused = str(error.strerror)
        finally:
            os.close(stdin)
            os.close(stdout)
        if refused:
            to_worker.close()
            from_worker.close()
            raise OSError(errno.EAGAIN, f"the worker could not be forked: {refused}")
        return worker

    def close(self) -> None:
        """End it, and with it its workers."""
        self._socket.shutdown(socket.SHUT_RDWR)
        try:
            self._process.wait(_CLOSING_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _kill(self, pid: int) -> None:
        with suppress(OSError):  # it has ended, and with it its workers
            self._socket.send(KILL + str(pid).encode())

    def _listen(self) -> None:
        while told := self._told():
            if "forked" in told:
                assert self._asked is not None
                self._asked.pid = told["forked"]
                self._workers[told["forked"]] = self._asked
                self._answers.put("")
            elif "ended" in told:
                self._workers.pop(told["ended"]).end(told["code"])
            else:
                self._answers.put(told["refused"])
        self.ended = True
        self._process.wait()
        for worker in self._workers.values():
            worker.end(-signal.SIGKILL)
        self._answers.put("the process that forks it has ended")  # for whoever has just asked

    def _told(self) -> dict[str, Any]:
        """The next message of the server; empty at its end."""
        try:
            message = self._socket.recv(LONGEST)
        except OSError:
            return {}
        return json.loads(message) if message else {}
