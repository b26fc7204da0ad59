"""The whole driver with every frame looked at: a source, the acquisition loop and the ring, and a reader that compares.

`python -m whole_driver SPEC FRAMES PICTURES`, in a process that sees the virtual cameras; it reads until FRAMES frames,
lost ones included, and prints an `Account` as JSON. Without PICTURES nothing is compared, for a measurement of speed.
"""

import json
import os
import subprocess
import sys
import threading
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from spiked_driver import acquire, open_source
from virtual_camera.rig import Report, VirtualCameras
from virtual_camera.stream import COMPACT_BYTES, STAMP_BYTES

from spiked.ring import End, Frames, Gap, Policy, Ring, RingReader, RingWriter

_HERE = Path(__file__).resolve().parent


@dataclass
class Account:
    """What became of every frame of a capture."""

    received: int = 0
    """Frames at the far end of the ring, each equal to what the camera sent under its index."""
    wrong: int = 0
    """Frames that are not."""
    lost: dict[str, int] = field(default_factory=dict)
    """By cause."""
    gaps: int = 0
    largest_gap: tuple[int, int] | None = None
    """First frame and count."""
    end: int = 0
    """Received and lost."""
    first_number: int | None = None
    """The camera's number of frame 0."""
    seconds: float = 0.0
    """From the first frame to the last."""
    acquisition_cpu_s: float = 0.0

    @property
    def lost_frames(self) -> int:
        """All causes together."""
        return sum(self.lost.values())

    def check(self, report: Report) -> None:
        """Every frame of the camera within the capture was received or told lost, and none was invented."""
        assert self.wrong == 0
        assert self.received + self.lost_frames == self.end
        assert self.first_number is not None
        first, end = self.first_number, self.first_number + self.end
        within = [range(max(first, run.first), min(end, run.first + run.count)) for run in report.sent]
        sent = sum(map(len, within))
        assert report.next_frame >= end, "the capture has more frames than there were"
        assert self.received <= sent
        not_sent = self.end - sent
        assert self.lost_frames == not_sent + (sent - self.received)


def run(rig: VirtualCameras, spec: str, frames: int, pictures: Path | None, *, timeout_s: float = 240.0) -> Account:
    """Play a capture of so many frames against the rig's cameras, and give its account."""
    path = os.pathsep.join([str(_HERE), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, "-m", "whole_driver", spec, str(frames), *([str(pictures)] if pictures else [])],
        stdout=subprocess.PIPE,
        text=True,
        env={**rig.environment, "PYTHONPATH": path},
        timeout=timeout_s,
        check=True,
    )
    return Account(**json.loads(done.stdout))


class _Judge:
    """Compares what comes out of the ring with the pictures."""

    def __init__(self, pictures: NDArray[np.uint8]) -> None:
        self._pictures = pictures
        self.account = Account()
        self._started_s = 0.0

    def take(self, first: int, frames: NDArray[np.uint8]) -> int:
        """How many of the frames are wrong."""
        numbers = frames[:, :STAMP_BYTES].copy().view("<i8")[:, 0]
        if self.account.first_number is None:
            self.account.first_number = int(numbers[0]) - first
            self._started_s = time.monotonic()
        expected = self.account.first_number + first + np.arange(len(frames))
        self.account.seconds = time.monotonic() - self._started_s
        if (numbers == expected).all():
            at = int(numbers[0]) % len(self._pictures)
            sent = self._pictures[at : at + len(frames)]
            if len(sent) == len(frames) and np.array_equal(frames[:, STAMP_BYTES:], sent[:, STAMP_BYTES:]):
                return 0
        sent = self._pictures[expected % len(self._pictures)]
        same = (frames[:, STAMP_BYTES:] == sent[:, STAMP_BYTES:]).all(axis=1) & (numbers == expected)
        return int((~same).sum())


def _judge(name: str, pictures: str) -> None:
    judge = _Judge(np.fromfile(pictures, np.uint8).reshape(-1, COMPACT_BYTES))
    account = judge.account
    reader = RingReader.attach(name, Policy.LOSSLESS, "judge")
    while not isinstance(item := reader.next(1.0), End):
        if isinstance(item, Frames):
            wrong = judge.take(item.first, item.data)
            if item.release():
                account.received += item.count
                account.wrong += wrong
        elif isinstance(item, Gap):
            account.lost[item.cause] = account.lost.get(item.cause, 0) + item.count
            account.gaps += 1
            if account.largest_gap is None or item.count > account.largest_gap[1]:
                account.largest_gap = (item.first, item.count)
    account.end = item.frames
    print(json.dumps(asdict(account)))


def _unwatched(spec: str, frames: int) -> None:
    source = open_source(spec)
    with RingWriter.create(source.sensor) as writer:
        start_s, cpu_s = time.monotonic(), time.process_time()
        acquire(source, writer, threading.Event(), limit_frames=frames)
        seconds, cpu_s = time.monotonic() - start_s, time.process_time() - cpu_s
        status = Ring.attach(writer.name).status().writer
        lost = {cause: count for cause, count in status.lost.items() if count}
        account = Account(
            received=status.committed, lost=lost, end=status.next_frame, seconds=seconds, acquisition_cpu_s=cpu_s
        )
    print(json.dumps(asdict(account)))


def _capture(spec: str, frames: int, pictures: str) -> None:
    source = open_source(spec)
    stop = threading.Event()
    with RingWriter.create(source.sensor) as writer:
        judge = subprocess.Popen(
            [sys.executable, "-m", "whole_driver", "judge", writer.name, pictures], stdout=subprocess.PIPE, text=True
        )
        start_s = time.process_time()
        acquire(source, writer, stop, limit_frames=frames, consumers=1)
        cpu_s = time.process_time() - start_s
        answer = json.loads(judge.communicate()[0])
    print(json.dumps({**answer, "acquisition_cpu_s": cpu_s}))


if __name__ == "__main__":
    if sys.argv[1] == "judge":
        _judge(sys.argv[2], sys.argv[3])
    elif len(sys.argv) == 3:
        _unwatched(sys.argv[1], int(sys.argv[2]))
    else:
        _capture(sys.argv[1], int(sys.argv[2]), sys.argv[3])
