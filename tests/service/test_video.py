"""`spiked video` as a user gives it."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from spiked_service.workers.messages import VideoCommand
from spiked_service.workers.slow_motion import slow_motion_of

from spiked.errors import ConfigurationError
from spiked.pose import exp_so3
from spiked.recording import RecordingWriter, open_recording
from spiked.scene import Scene
from spiked.sensor import Sensor
from spiked.simulate import Room, SimulatedCamera
from spiked.simulate.motion import hand_shake
from spiked.trajectory import Trajectory

from ..room_map import OPTICS, room_map


def spiked(*arguments: object) -> subprocess.CompletedProcess[str]:
    """The command."""
    command = [sys.executable, "-m", "spiked_service", "video", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)


def read(path: Path) -> list[np.ndarray]:
    """Pictures."""
    with av.open(str(path)) as file:
        return [frame.to_ndarray(format="gray") for frame in file.decode(video=0)]


@pytest.fixture(scope="module")
def ply(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The built-in room as splats, without a path."""
    place = tmp_path_factory.mktemp("scene") / "room.ply"
    scene: Scene = room_map(3, (0.0,)).scene
    scene.write_ply(place)
    return place


def test_a_scene_is_flown_through_by_bookmarks(ply: Path, tmp_path: Path) -> None:
    rotations, centres = hand_shake(Room(seed=3).stage(OPTICS, flow_px=0.15), 3).poses([0.5])
    turned = rotations[0] @ exp_so3(np.array([0, 0.3, 0]))
    marks = Trajectory(np.arange(2.0), np.stack([rotations[0], turned]), np.repeat(centres, 2, 0))
    marks.write_tum(tmp_path / "marks.tum")
    size = "--seconds", 1, "--fps", 10, "--width", 160
    done = spiked("scene", ply, "--path", tmp_path / "marks.tum", *size, "-o", tmp_path / "a.mp4")
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == f"{tmp_path / 'a.mp4'}: 10 pictures of 160 x 90, 1 s"
    pictures = read(tmp_path / "a.mp4")
    assert len(pictures) == 10 and pictures[0].shape == (90, 160)
    assert pictures[0].std() > 10, "there is something to see"
    assert np.abs(pictures[0].astype(int) - pictures[-1]).mean() > 5, "the camera has turned"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "has no path: name one with --path FILE.tum"),
        (("--path", "nothing.tum"), "cannot read trajectory nothing.tum"),
        (("--path", "recorded"), "has no path"),
    ],
)
def test_a_scene_without_a_path_is_told(arguments: tuple[str, ...], message: str, ply: Path, tmp_path: Path) -> None:
    done = spiked("scene", ply, "-o", tmp_path / "a.mp4", *arguments)
    assert done.returncode == 2
    assert message in done.stderr and "Traceback" not in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_recording_is_shown_slowly_and_what_was_lost_is_said(tmp_path: Path) -> None:
    sensor = Sensor(64, 48, 2000.0)
    frames = SimulatedCamera(sensor, seed=1).next_frames(400)
    with RecordingWriter(tmp_path / "a.dat", sensor) as writer:
        writer.append(frames[:200])
        writer.gap(200, 20, "usb")
        writer.append(frames[220:])
    done = spiked("recording", tmp_path / "a.dat", "--slower", 10, "--compensate", "--window", 8)
    assert done.returncode == 0, done.stderr
    pictures = read(tmp_path / "a.mp4")
    black = sum(picture.max() < 20 for picture in pictures)
    assert len(pictures) == 60 and black > 0
    assert f"60 pictures, {black} of them black: their frames were lost, 2 s, 10 times slower" in done.stdout


def test_ten_seconds_are_the_default(tmp_path: Path) -> None:
    sensor = Sensor(16, 16, 2000.0)
    with RecordingWriter(tmp_path / "a.dat", sensor) as writer:
        writer.append(SimulatedCamera(sensor, seed=1).next_frames(100))
    done = spiked("recording", tmp_path / "a.dat", "--fps", 5, "-o", tmp_path / "b.mp4")
    assert done.returncode == 0, done.stderr
    assert "50 pictures, 10 s, 200 times slower" in done.stdout


@pytest.mark.parametrize("more", [{"window": 4096}, {"compensated": True}])
def test_slow_motion_that_would_take_hours_is_refused(tmp_path: Path, more: dict[str, Any]) -> None:
    sensor = Sensor(1000, 1000, 20_000.0)
    with RecordingWriter(tmp_path / "large.dat", sensor) as writer:
        writer.append(np.zeros((20, sensor.frame_bytes), np.uint8))
    recording = open_recording(writer.path)
    asked: dict[str, Any] = {"window": 16, "compensated": False, "begin_s": 0.0, "end_s": None}
    command = VideoCommand(recording=writer.path, out=tmp_path / "a.mp4", slower=1e6, pictures_a_second=30.0, **asked)
    assert len(slow_motion_of(command, recording).times_s(recording)) == 30_000
    with pytest.raises(ConfigurationError, match="would take hours"):
        slow_motion_of(command.model_copy(update=more), recording)
