"""The service's end of a worker process."""

import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import IO

from spiked_service.logs import logger, relay
from spiked_service.messages import STOP, Logged, News, Order, Role, news_lines

_log = logger("spiked.service")
_LEAVE_S = 10.0
"""A spare that still starts leaves when it has started."""


class Spare:
    """A worker that has loaded what its role needs and stands by for an order."""

    def __init__(self, role: Role, log: Path) -> None:
        self.role = role
        self.log = log
        with log.open("ab") as errors:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "spiked_service.worker", role],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                process_group=0,  # Ctrl-C in the terminal is for the service alone
            )

    def dismiss(self) -> None:
        """It is not needed any more, and leaves."""
        assert self.process.stdin is not None and self.process.stdout is not None
        try:
            self.process.stdin.close()
        except BrokenPipeError:
            pass  # it was killed
        finally:
            self.process.stdout.close()
        threading.Thread(
            target=self.kill_after, args=(_LEAVE_S,), name=f"end of spare {self.role}", daemon=True
        ).start()

    def kill_after(self, timeout_s: float) -> None:
        """Wait for its end, and kill it if it does not come in time."""
        _wait_or_kill(self.process, timeout_s)


class Child:
    """A worker in a process of its own.

    Its stdin is its lease on life: when the service closes it, or dies in whatever way, the worker leaves. News and the
    end come on a thread of this object; nobody needs to poll.
    """

    def __init__(
        self,
        order: Order,
        log: Path,
        on_news: Callable[[News], None],
        on_exit: Callable[[str | None], None],
        spare: Spare | None = None,
    ) -> None:
        """Start it, or have a spare of the role do it. `on_exit` gets None for a good end, otherwise a sentence."""
        self.role: Role = order.role
        self._on_news = on_news
        self._on_exit = on_exit
        self._writing = threading.Lock()
        worker = spare if spare is not None and spare.process.poll() is None else Spare(order.role, log)
        self._log = worker.log
        self._process = worker.process
        assert self._process.stdin is not None and self._process.stdout is not None
        self._stdin: IO[bytes] = self._process.stdin
        self._stdout: IO[bytes] = self._process.stdout
        self._send(order.model_dump_json() + "\n")
        self._listener = threading.Thread(target=self._listen, name=f"news of {self.role}", daemon=True)
        self._listener.start()

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    def stop(self) -> None:
        """Ask it to end in good order, which may take a while."""
        self._send(STOP)

    def dismiss(self) -> None:
        """Ask it to leave at once."""
        with self._writing:
            try:
                self._stdin.close()
            except BrokenPipeError:
                return  # it has left already

    def kill_after(self, timeout_s: float) -> None:
        """Wait for its end, and kill it if it does not come in time."""
        _wait_or_kill(self._process, timeout_s)
        self._listener.join()

    def _send(self, line: str) -> None:
        with self._writing:
            try:
                self._stdin.write(line.encode())
                self._stdin.flush()
            except (BrokenPipeError, ValueError):
                return  # it is dead or dismissed, which on_exit tells

    def _listen(self) -> None:
        failure = None
        with self._stdout:
            for line in self._stdout:
                if not line.endswith(b"\n"):
                    break  # it was killed while it spoke
                try:
                    self._take(line)
                except Exception as error:  # whatever goes wrong here, the worker's end must still be told
                    _log.exception("news could not be taken", role=str(self.role))
                    failure = failure or f"the service failed over news of the {self.role} worker: {error!r}"
                    self.dismiss()
        code = self._process.wait()
        # Closing sends what could not be sent before, and it is dead: that must not keep its end from being told.
        with self._writing, suppress(BrokenPipeError):
            self._stdin.close()
        self._on_exit(failure or self._verdict(code))

    def _take(self, line: bytes) -> None:
        news = news_lines.validate_json(line)
        if isinstance(news, Logged):
            relay(news)
        else:
            self._on_news(news)

    def _verdict(self, code: int) -> str | None:
        if code == 0:
            return None
        if code < 0:
            return f"the {self.role} worker was killed by signal {-code}"
        lines = self._log.read_text(errors="replace").strip().splitlines() if self._log.exists() else []
        return f"the {self.role} worker failed with exit code {code}: {lines[-1] if lines else 'it left no word'}"


def _wait_or_kill(process: subprocess.Popen[bytes], timeout_s: float) -> None:
    try:
        process.wait(timeout_s)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
