"""The driver in a process of its own, and what it has observed so far."""

import json
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from virtual_camera.rig import Report

_HERE = Path(__file__).resolve().parent
PATIENCE_S = 40.0


@dataclass
class Observed:
    """What the driver said, in order."""

    states: list[tuple[str, str]] = field(default_factory=list)
    """State and reason."""
    gaps: list[tuple[int, int, str]] = field(default_factory=list)
    """First, count, cause."""
    runs: dict[tuple[int, int], int] = field(default_factory=dict)
    """Frames that followed one another: capture index and camera number of the first, and how many."""
    warnings: list[str] = field(default_factory=list)
    opened: bool = False
    error: str | None = None
    closed_s: float | None = None
    times: dict[str, list[float]] = field(default_factory=dict)
    """When each state began, in seconds since the driver's start."""

    @property
    def received(self) -> int:
        """Frames."""
        return sum(self.runs.values())

    @property
    def lost(self) -> int:
        """Frames."""
        return sum(count for _, count, _ in self.gaps)

    @property
    def end(self) -> int:
        """Received and lost, if they are the whole capture from 0 on without an overlap; raises AssertionError."""
        pieces = [(first, count) for (first, _), count in self.runs.items() if count]
        pieces += [(first, count) for first, count, _ in self.gaps]
        expected = 0
        for first, count in sorted(pieces):
            assert first == expected
            expected += count
        return expected

    @property
    def offsets(self) -> list[int]:
        """Camera number minus index of each run, in order; one and the same while the camera's count runs on."""
        offsets = [number - index for (index, number), count in sorted(self.runs.items()) if count]
        return [offset for at, offset in enumerate(offsets) if not at or offset != offsets[at - 1]]


class Machine(Protocol):
    """Where the driver runs."""

    @property
    def environment(self) -> Mapping[str, str]:
        """In which it finds the cameras."""
        ...


class Driver:
    """`driver_client` as a process that sees the virtual cameras."""

    def __init__(self, rig: Machine, spec: str, *, user: int | None = None, patience_s: float = PATIENCE_S) -> None:
        self._patience_s = patience_s
        path = os.pathsep.join([str(_HERE), os.environ.get("PYTHONPATH", "")])
        self._process = subprocess.Popen(
            [sys.executable, "-m", "driver_client", spec, *([] if user is None else [str(user)])],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**rig.environment, "PYTHONPATH": path},
        )
        self.observed = Observed()
        self._lines: queue.Queue[str] = queue.Queue()
        threading.Thread(target=self._listen, daemon=True).start()

    def wait_for(self, condition: Callable[[Observed], Any]) -> Observed:
        """Until the condition is fulfilled. Raises TimeoutError with what was observed."""
        seconds = self._patience_s
        deadline_s = time.monotonic() + seconds
        while not condition(self.observed):
            try:
                self._hear(self._lines.get(timeout=max(0.0, deadline_s - time.monotonic())))
            except queue.Empty as error:
                raise TimeoutError(f"not so within {seconds:g} s: {str(self.observed)[:5000]}") from error
        return self.observed

    def wait_for_state(self, *states: str, after: int = 0) -> Observed:
        """Until one of the states came, the first `after` states left out."""
        return self.wait_for(lambda observed: any(state in states for state, _ in observed.states[after:]))

    def pause(self) -> None:
        """Read nothing until `resume`, as a busy host does."""
        self._command("pause\n")

    def resume(self) -> None:
        """End a pause."""
        self._command("resume\n")

    def suspend(self, seconds: float) -> None:
        """Stop the process wherever it is, for so long."""
        self._process.send_signal(signal.SIGSTOP)
        time.sleep(seconds)
        self._process.send_signal(signal.SIGCONT)

    def wait_for_frames(self, count: int) -> Observed:
        """Until so many more frames came than by now."""
        now = self.observed.received
        return self.wait_for(lambda observed: observed.received >= now + count)

    def stop(self) -> Observed:
        """Stop it and wait for its end; frames and gaps are accounted for without a hole."""
        self._command("stop\n")
        self.wait_for(lambda observed: observed.closed_s is not None or observed.error)
        self.observed.end  # noqa: B018
        return self.observed

    def close(self) -> None:
        """End the process."""
        if self._process.poll() is None:
            self._process.kill()
        self._process.communicate()

    def _command(self, text: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(text)
        self._process.stdin.flush()

    def _listen(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self._lines.put(line)
        self._lines.put("")

    def _hear(self, line: str) -> None:
        if not line:
            raise RuntimeError(f"the driver's process ended with {self._process.wait()}: {self.observed}")
        match json.loads(line):
            case {"run": [index, number, count]}:
                self.observed.runs[index, number] = count
            case {"gap": [first, count, cause]}:
                self.observed.gaps.append((first, count, cause))
            case {"state": state, "reason": reason, "at": at}:
                self.observed.states.append((state, reason))
                self.observed.times.setdefault(state, []).append(at)
            case {"warning": text}:
                self.observed.warnings.append(text)
            case {"opened": True}:
                self.observed.opened = True
            case {"closed_s": seconds}:
                self.observed.closed_s = seconds
            case {"error": message}:
                self.observed.error = message


def check_sent(observed: Observed, report: Report, *, offsets: int = 1) -> None:
    """Every frame that was received is one that the camera sent, and index and camera's number go together.

    They differ by one and the same number, or by at most `offsets` of them if the index went on by the clock in
    between, which may be right to the frame. What was not received is in gaps: on a loaded machine the camera may drop
    frames at any time.
    """
    assert 1 <= len(observed.offsets) <= offsets, f"index and number differ by {observed.offsets}; runs {observed.runs}"
    for (_, number), count in observed.runs.items():
        assert not count or _within(report, number, count), f"frames {number} to {number + count - 1} were not all sent"


def _within(report: Report, number: int, count: int) -> bool:
    """Whether frames were sent, one after another or with others between."""
    if any(run.first <= number and number + count <= run.first + run.count for run in report.sent):
        return True
    return all(report.runs(one) for one in range(number, number + count))
