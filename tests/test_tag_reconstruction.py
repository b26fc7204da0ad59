"""The scale of a reconstruction by a tag in the view, from spikes on: the figure of docs/exports.md."""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from tag_card import SIDE_M, tag_card

from spiked.evaluate import similarity_of_trajectories
from spiked.recording import RecordingWriter
from spiked.sensor import Intrinsics, Sensor
from spiked.simulate import Room, SimulatedCamera
from spiked.simulate.motion import hand_shake
from spiked.trajectory import Trajectory

OPTICS = Intrinsics.from_fov(400, 248, 60.0)
SENSOR = Sensor(400, 248, 20_000.0, intrinsics=OPTICS)
MOST = 5e-3
"""Relative error of the scale, at most: the requirement."""


def recorded(folder: Path, frames: int, flow_px: float, parallax: float) -> Trajectory:
    """A recording of the room with a tag of 10 cm in 0.75 m, `tag.dat`, and the true path."""
    room = Room(seed=3, card=tag_card())
    motion = hand_shake(room.stage(OPTICS, flow_px=flow_px, parallax=parallax), 3)
    camera = SimulatedCamera(SENSOR, 3, motion, room)
    with RecordingWriter(folder / "tag.dat", SENSOR) as writer:
        for _ in range(0, frames, 64):
            writer.append(camera.next_frames(64))
    middles = np.arange(frames) + 0.5
    return Trajectory(middles / SENSOR.frame_rate_hz, *motion.poses(middles))


@pytest.mark.slow
@pytest.mark.validation
@pytest.mark.parametrize(("frames", "flow_px", "parallax"), [(1280, 0.2, 0.12), (2048, 0.06, 0.06)])
def test_a_tag_of_10_cm_gives_metres_within_half_a_percent(
    tmp_path: Path, figure: Callable[[str, object, str], None], frames: int, flow_px: float, parallax: float
) -> None:
    truth = recorded(tmp_path, frames, flow_px, parallax)
    for command in (
        ["reconstruct", str(tmp_path / "tag.dat"), "-o", str(tmp_path / "out")],
        ["scale", str(tmp_path / "out"), "--tag", str(SIDE_M)],
    ):
        subprocess.run([sys.executable, "-m", "spiked_service", *command], check=True, capture_output=True)
    estimate = Trajectory.read_tum(tmp_path / "out" / "trajectory.tum")
    units = similarity_of_trajectories(truth=truth, estimate=estimate, frame_rate_hz=SENSOR.frame_rate_hz).scale
    found = json.loads((tmp_path / "out" / "scale.json").read_text())
    error = found["metres_per_unit"] * units - 1
    figure(f"scale by a tag of 10 cm, {flow_px} px a frame", f"{100 * error:+.2f} %", f"at most {MOST:.1%}")
    assert abs(error) <= MOST
    assert 0 < found["sigma"] < MOST
