"""The service's end of a worker process."""

import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import IO

from spiked_service.messages import STOP, News, Order, news_lines


class Child:
    """A worker in a process of its own.

    Its stdin is its lease on life: when the service closes it, or dies in whatever way, the worker leaves. News and the
    end come on a thread of this object; nobody needs to poll.
    """

    def __init__(
        self, order: Order, log: Path, on_news: Callable[[News], None], on_exit: Callable[[str | None], None]
    ) -> None:
        """Start it. `on_exit` gets None for a good end, otherwise a sentence."""
        self.role = order.role
        self._log = log
        self._on_news = on_news
        self._on_exit = on_exit
        self._writing = threading.Lock()
        with log.open("ab") as errors:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "spiked_service.worker", order.role],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                process_group=0,  # Ctrl-C in the terminal is for the service alone
            )
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
        try:
            self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._listener.join()

    def _send(self, line: str) -> None:
        with self._writing:
            try:
                self._stdin.write(line.encode())
                self._stdin.flush()
            except (BrokenPipeError, ValueError):
                return  # it is dead or dismissed, which on_exit tells

    def _listen(self) -> None:
        with self._stdout:
            for line in self._stdout:
                self._on_news(news_lines.validate_json(line))
        self._on_exit(self._verdict(self._process.wait()))

    def _verdict(self, code: int) -> str | None:
        if code == 0:
            return None
        if code < 0:
            return f"the {self.role} worker was killed by signal {-code}"
        lines = self._log.read_text(errors="replace").strip().splitlines()
        return f"the {self.role} worker failed with exit code {code}: {lines[-1] if lines else 'it left no word'}"
