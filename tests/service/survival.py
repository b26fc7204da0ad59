"""What the tests of survival share: a service without HTTP, its workers real processes."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import psutil
from numpy.typing import NDArray
from spiked_service.api.announce import BusAnnouncer
from spiked_service.events import Bus
from spiked_service.keeping import Keeping
from spiked_service.snapshot import Snapshot

from spiked.recording import RecordingWriter, open_recording
from spiked.sensor import Sensor

SENSOR = Sensor(96, 64, 20_000.0)
SMALL = "sim:?width=96&height=64"
PATIENCE_S = 150.0


def wait_for(condition: Callable[[], object], what: str) -> None:
    """Poll until the condition holds; the test fails if it does not in time."""
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, f"waited in vain until {what}"
        time.sleep(0.02)


def over(keeping: Keeping, capture_id: str) -> Snapshot:
    """The capture when it is over."""
    wait_for(lambda: keeping.captures.get(capture_id).row.state.over, "the capture is over")
    return keeping.captures.get(capture_id)


def received(keeping: Keeping, capture_id: str) -> int:
    """Frames that have come so far."""
    counters = keeping.captures.get(capture_id).counters
    return 0 if counters is None else counters.received


@contextmanager
def kept(data: Path) -> Iterator[Keeping]:
    """A service on a data folder."""
    keeping = Keeping(data, BusAnnouncer(Bus()))
    try:
        yield keeping
    finally:
        keeping.close()


def random_recording(path: Path, frames: int, sensor: Sensor = SENSOR) -> NDArray[np.uint8]:
    """A recording of noise, and its frames uint8 [n, frame_bytes]."""
    content = np.random.default_rng(frames).integers(0, 256, (frames, sensor.frame_bytes), np.uint8)
    with RecordingWriter(path, sensor) as writer:
        writer.append(content)
    return content


def assert_holds(path: Path, frames: NDArray[np.uint8]) -> None:
    """The recording holds of these frames, endlessly repeated, each one where its index in the capture says."""
    recording = open_recording(path)
    index = np.array([recording.capture_index(k) for k in range(recording.frames)])
    wrong = (recording.data != frames[index % len(frames)]).any(axis=1)
    assert not wrong.any(), f"{wrong.sum()} of {len(index)} frames are wrong, the first is {index[wrong][0]}"


def children() -> list[psutil.Process]:
    """The workers of this process."""
    found = []
    for child in psutil.Process().children():
        with suppress(psutil.NoSuchProcess):  # a zombie has no command line
            if "spiked_service.worker" in child.cmdline()[1:3]:
                found.append(child)
    return found
