"""What the tests of survival share: a service without HTTP, its workers real processes."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import psutil
from numpy.typing import NDArray
from spiked_service.api.bus_notifier import BusNotifier
from spiked_service.captures.archive import DataStore
from spiked_service.daemon import open_data_store
from spiked_service.events.bus import Bus
from spiked_service.store.rows import ReconstructionRow
from spiked_service.store.snapshot import Snapshot
from waiting import until

from spiked.recording import RecordingWriter, open_recording
from spiked.sensor import Intrinsics, Sensor
from spiked.simulate import MotionKind, SimulatedCamera

SENSOR = Sensor(96, 64, 20_000.0)
SMALL = "sim:?width=96&height=64"


def over(data_store: DataStore, capture_id: str) -> Snapshot:
    """The capture when it is over."""
    until(lambda: data_store.captures.get(capture_id).row.state.over, "the capture is over")
    return data_store.captures.get(capture_id)


def jobs_of(data_store: DataStore, capture_id: str) -> list[ReconstructionRow]:
    """The reconstructions of a capture, oldest first."""
    return data_store.reconstructions.rows.page(capture_id=capture_id).items[::-1]


def ended(data_store: DataStore, job: ReconstructionRow) -> ReconstructionRow:
    """The reconstruction when it is over."""
    until(lambda: data_store.reconstructions.rows.get(job.id).state.over, f"{job.id} is over")
    return data_store.reconstructions.rows.get(job.id)


def received(data_store: DataStore, capture_id: str) -> int:
    """Frames that have come so far."""
    counters = data_store.captures.get(capture_id).counters
    return 0 if counters is None else counters.received


@contextmanager
def kept(data: Path) -> Iterator[DataStore]:
    """A service on a data folder."""
    data_store = open_data_store(data, BusNotifier(Bus()))
    try:
        yield data_store
    finally:
        data_store.close()


def random_recording(path: Path, frames: int, sensor: Sensor = SENSOR) -> NDArray[np.uint8]:
    """A recording of noise, and its frames uint8 [n, frame_bytes]."""
    content = np.random.default_rng(frames).integers(0, 256, (frames, sensor.frame_bytes), np.uint8)
    with RecordingWriter(path, sensor) as writer:
        writer.append(content)
    return content


def still_recording(path: Path) -> Path:
    """A recording of a camera that stands still: there is no path in it."""
    return _room_recording(path, 400, flow_px=1e-6, parallax=1e-6)


def moving_recording(path: Path) -> Path:
    """A recording of a camera that moves: path and scene are found."""
    return _room_recording(path, 500, flow_px=0.3, parallax=0.5)


def _room_recording(path: Path, frames: int, flow_px: float, parallax: float) -> Path:
    sensor = Sensor(160, 96, 20_000.0, intrinsics=Intrinsics.from_fov(160, 96, 60))
    camera = SimulatedCamera(sensor, seed=4, motion=MotionKind.ARC, flow_px=flow_px, parallax=parallax)
    with RecordingWriter(path, sensor) as writer:
        writer.append(camera.next_frames(frames))
    return path


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
            if "spiked_service.workers" in child.cmdline():
                found.append(child)
    return found
