"""A result with an exact scene and path, and its recording."""

import numpy as np
import pytest

from spiked.export import ExportSource
from spiked.recording import RecordingWriter, open_recording
from spiked.simulate import Room, SimulatedCamera
from spiked.simulate.motion import hand_shake
from spiked.trajectory import Trajectory

from ..room_map import GAIN, OPTICS, SENSOR, room_map

FRAMES = 400


@pytest.fixture(scope="session")
def source(tmp_path_factory: pytest.TempPathFactory) -> ExportSource:
    """The built-in room as a splat for each pixel of some views, and a camera that moves through it."""
    room = Room(seed=3)
    motion = hand_shake(room.stage(OPTICS, flow_px=0.15), 3)
    camera = SimulatedCamera(SENSOR, 3, motion, room, step_px=0.3, gain=GAIN)
    file = tmp_path_factory.mktemp("room") / "room.dat"
    with RecordingWriter(file, SENSOR) as writer:
        writer.append(camera.next_frames(FRAMES))
    frames = np.arange(0, FRAMES, 4)
    rotations, centres = motion.poses(frames + 0.5)
    path = Trajectory((frames + 0.5) / SENSOR.frame_rate_hz, rotations, centres)
    scene = room_map(3, (0.0,)).scene
    scene.white = GAIN
    return ExportSource(path, SENSOR, scene, open_recording(file), name="room")
