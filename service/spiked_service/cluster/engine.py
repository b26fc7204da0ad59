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
        self._tasks: dict[str, str] = {}
        """Attempts that agents work for now, by those that they were submitted for, which the engine knows them by."""
        self._closed = False

    def submit(self, attempt: str, arguments: list[str]) -> None:
        """Have an agent started. Raises OSError."""
        with self._lock:
            self._tasks[attempt] = attempt
            with suppress(BrokenPipeError):  # it has died, and the thread that listens will say so
                self._tell({"submit": attempt, "arguments": arguments})

    def hand_on(self, old: str, new: str) -> None:
        """The agent of the attempt `old`, which is over, works for `new`: what was submitted for that is cancelled."""
        with self._lock:
            self._tasks.pop(new, None)
            task = self._task_of(old)
            self._tasks[task] = new
            self._try_to_tell({"keep": task})
            self._try_to_tell({"cancel": new, "after_s": 0.0})

    def cancel(self, attempt: str, after_s: float) -> None:
        """Have what is left of an attempt after `after_s` ended."""
        with self._lock:
            task = self._task_of(attempt)
            if self._tasks.get(task, attempt) == attempt:  # else its agent works for another one
                self._try_to_tell({"cancel": task, "after_s": after_s})

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

    def _task_of(self, attempt: str) -> str:
        """What has its agent; the attempt itself if that is not known, since an earlier engine may have it."""
        return next((task for task, worked_for in self._tasks.items() if worked_for == attempt), attempt)

    def _try_to_tell(self, message: dict[str, object]) -> None:
        """Tell an engine that runs; another one would not know what this is about."""
        if self._process is not None:
            with suppress(OSError):
                self._tell(message)

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
            lost = [] if self._closed else list(self._tasks)
        if lost:
            _log.warning("engine ended", engine=self._options.kind, code=code, log=str(self._log))
        for task in lost:
            self._forget(task, f"the engine {self._options.kind} has ended; see {self._log}", False)

    def _forget(self, task: str, reason: str, certain: bool) -> None:
        with self._lock:
            attempt = self._tasks.pop(task, None)
        if attempt is not None:
            self._on_end(attempt, reason, certain)
