"""Turns a process that has imported the modules of a role into a server that forks workers on request.

Its stdin is a socket of the process that asks, which says `fork`, with the three standard files of the worker, or `kill
PID`. It is told as JSON which process was forked, and which has ended with which exit code.
"""

import gc
import json
import os
import selectors
import signal
import socket
import warnings
from contextlib import suppress

from spiked.lifetime import end_with

FORKS = "--forks"
"""Argument of `python -m spiked_service.workers ROLE` for such a server."""
LONGEST = 4096
"""Bytes of a message in either direction."""
FORK = b"fork"
"""Asks for a worker."""
KILL = b"kill "
"""Before the process id of a worker, which is killed with the processes that it has started."""


def become_worker() -> bool:
    """Serve until the socket is closed, then return False. Each worker returns True, with its own standard files."""
    gc.collect()
    gc.freeze()  # the collector of a worker would copy the pages of what was imported
    return _Server().serve()


class _Server:
    """The parent of the workers: it alone can wait for them. Runs on one thread, since only that survives a fork."""

    def __init__(self) -> None:
        self._asking = socket.socket(fileno=os.dup(0))
        self._workers: dict[int, int] = {}
        """Process ids by the descriptors that become readable when they end."""
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._asking, selectors.EVENT_READ)

    def serve(self) -> bool:
        """Whether this is a worker; False when nobody asks any more."""
        while True:
            for key, _ in self._selector.select():
                if key.fileobj is not self._asking:
                    self._ended(key.fd)
                    continue
                asked, files, _, _ = socket.recv_fds(self._asking, LONGEST, 3)
                if not asked:
                    return False
                if asked == FORK and self._fork(files):
                    return True
                if asked.startswith(KILL):
                    self._kill(int(asked.removeprefix(KILL)))

    def _fork(self, files: list[int]) -> bool:
        server = os.getpid()
        try:
            with warnings.catch_warnings():
                # OpenBLAS has threads, which it ends before the fork and starts again when they are needed.
                warnings.simplefilter("ignore", DeprecationWarning)
                pid = os.fork()
        except OSError as error:
            _close(files)
            self._tell({"refused": error.strerror})
            return False
        os.setpgid(pid, 0)  # by both: its group is there whoever runs first
        if pid:
            _close(files)
            descriptor = os.pidfd_open(pid)
            self._workers[descriptor] = pid
            self._selector.register(descriptor, selectors.EVENT_READ)
            self._tell({"forked": pid})
            return False
        end_with(server)
        self._selector.close()
        self._asking.close()
        _close(list(self._workers))
        for number, file in enumerate(files):
            os.dup2(file, number)
        _close(files)
        return True

    def _ended(self, descriptor: int) -> None:
        pid = self._workers.pop(descriptor)
        self._selector.unregister(descriptor)
        os.close(descriptor)
        _, status = os.waitpid(pid, 0)
        self._tell({"ended": pid, "code": os.waitstatus_to_exitcode(status)})

    def _kill(self, pid: int) -> None:
        if pid in self._workers.values():  # it was not waited for, so no other process has its id
            with suppress(ProcessLookupError):
                os.killpg(pid, signal.SIGKILL)

    def _tell(self, message: dict[str, object]) -> None:
        with suppress(BrokenPipeError, ConnectionResetError):  # nobody asks any more, which the next read says
            self._asking.send(json.dumps(message).encode())


def _close(descriptors: list[int]) -> None:
    for descriptor in descriptors:
        os.close(descriptor)
