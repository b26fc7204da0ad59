"""The engine of a cluster: a process that submits agents by Ray or submitit, and says when they have ended.

It is a process of its own so that neither library, nor what they do to signals and threads, is in the service.
"""

import json
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path

from spiked_service.events.logging import logger

_log = logger("spiked.cluster")


@dataclass(frozen=True)
class EngineOptions:
    """What the engine is told at its start."""

    kind: str
    """Module of `spiked_service.cluster.engines`: ray or submitit."""
    cpus: int
    """Cores of a job."""
    gpus: float
    """GPUs of a job."""
    address: str = ""
    """Of Ray's head; empty: a cluster of this machine."""
    folder: str = ""
    """Where submitit keeps its files; all machines see it."""
    options: dict[str, str] = field(default_factory=dict)
    """For submitit: parameters such as `slurm_partition`."""


class Engine:
    """The service's end of the process of the engine, which is started when it is needed. Thread-safe."""

    def __init__(self, options: EngineOptions, log: Path, on_end: Callable[[str, str, bool], None]) -> None:
        """`on_end` gets an attempt that the engine has ended, the reason, and whether it runs no more.

        It is called on a thread of this object.
        """
        self._options = options
        self._log = log
        self._on_end = on_end
        self._lock = threading.Lock()
        self._process: subprocess.Popen[str] | None = None
        self._submitted: set[str] = set()
        self._closed = False

    def submit(self, attempt: str, arguments: list[str]) -> None:
        """Have an agent started. Raises OSError."""
        with self._lock:
            self._submitted.add(attempt)
            with suppress(BrokenPipeError):  # it has died, and the thread that listens will say so
                self._tell({"submit": attempt, "arguments": arguments})

    def cancel(self, attempt: str, after_s: float) -> None:
        """Have what is left of an attempt after `after_s` ended."""
        with self._lock:
            self._submitted.discard(attempt)
            if self._process is not None and not self._closed:
                with suppress(OSError):
                    self._tell({"cancel": attempt, "after_s": after_s})

    def close(self) -> None:
        """End the process; agents go on."""
        with self._lock:
            self._closed = True
            process = self._process
        if process is not None:
            assert process.stdin is not None
            with suppress(BrokenPipeError):
                process.stdin.close()
            try:
                process.wait(5)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    def _tell(self, message: dict[str, object]) -> None:
        if self._closed:
            return
        if self._process is None or self._process.poll() is not None:
            self._process = self._start()
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(message) + "\n")
        self._process.stdin.flush()

    def _start(self) -> "subprocess.Popen[str]":
        with self._log.open("ab") as errors:
            process = subprocess.Popen(
                [sys.executable, "-P", "-m", "spiked_service.cluster.engines", json.dumps(asdict(self._options))],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
                process_group=0,
            )
        threading.Thread(target=self._listen, args=(process,), name="engine", daemon=True).start()
        return process

    def _listen(self, process: "subprocess.Popen[str]") -> None:
        assert process.stdout is not None
        with process.stdout:
            for line in process.stdout:
                with suppress(ValueError):  # a line that was cut off
                    ended = json.loads(line)
                    self._forget(ended["ended"], ended["reason"], True)
        code = process.wait()
        with self._lock:
            lost = set() if self._closed else set(self._submitted)
        if lost:
            _log.warning("engine ended", engine=self._options.kind, code=code, log=str(self._log))
        for attempt in lost:
            self._forget(attempt, f"the engine {self._options.kind} has ended; see {self._log}", False)

    def _forget(self, attempt: str, reason: str, certain: bool) -> None:
        with self._lock:
            known = attempt in self._submitted
            self._submitted.discard(attempt)
        if known:
            self._on_end(attempt, reason, certain)
