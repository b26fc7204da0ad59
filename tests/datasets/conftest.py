"""What is written into the layouts: the first frames of `living`, and of a path through the built-in room."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from spiked.recording import open_recording
from spiked.sensor import Intrinsics, Sensor
from spiked.simulate import MotionKind, SimulatedCamera
from spiked.trajectory import Trajectory

from .layouts import Source

FRAMES = 192
LIVING = Path(__file__).parents[3] / "shared" / "streams" / "living"


def living() -> Source:
    """The first frames of the stream of that name."""
    if not LIVING.is_dir():
        pytest.skip(f"there is no folder {LIVING}")
    recording = open_recording(LIVING / "living.dat")
    truth = Trajectory.read_tum(LIVING / "groundtruth.tum")
    path = Trajectory(truth.times_s[:FRAMES], truth.rotations[:FRAMES], truth.centres[:FRAMES])
    assert recording.sensor.intrinsics is not None
    return Source(recording.images(0, FRAMES), recording.sensor.intrinsics, path)


def room() -> Source:
    """An arc through the built-in room, of the same size."""
    sensor = Sensor(400, 250, 20_000.0, flipped=False, intrinsics=Intrinsics.from_fov(400, 250, 60))
    camera = SimulatedCamera(sensor, 3, MotionKind.ARC, flow_px=0.3, step_px=0.8)
    frames = np.unpackbits(camera.next_frames(FRAMES), axis=1, bitorder="little").reshape(FRAMES, 250, 400)
    times = (np.arange(FRAMES) + 0.5) / sensor.frame_rate_hz
    return Source(frames, camera.intrinsics, Trajectory(times, *camera.truth(np.arange(FRAMES))))


@pytest.fixture(scope="session")
def sources() -> Callable[[str], Source]:
    """Makes a source by its name, once."""
    made: dict[str, Source] = {}

    def get(name: str) -> Source:
        if name not in made:
            made[name] = {"living": living, "room": room}[name]()
        return made[name]

    return get


@pytest.fixture(params=["room", "living"])
def source(request: pytest.FixtureRequest, sources: Callable[[str], Source]) -> Source:
    """Each source in turn; that of the data beside the repository is skipped where there is none."""
    return sources(request.param)
