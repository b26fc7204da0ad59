"""A recording without a path says why: the camera stood still, only an object moves, or it is too short."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from staging import SENSOR, ObstructedCamera, behind, patch

from spiked.recon import Options, Reconstructor, State
from spiked.recon.odometry.stationarity import moving_object_share
from spiked.recording import open_recording
from spiked.sensor import Intrinsics, Sensor
from spiked.simulate import MotionKind, SimulatedCamera

FRAMES = 480
STILL = 1e-6
NOTHING = "the camera stood still and nothing that can be followed moves"


def standing(**more: object) -> ObstructedCamera:
    return ObstructedCamera(SENSOR, seed=4, motion=MotionKind.ARC, flow_px=STILL, parallax=STILL, **more)


@cache
def stood() -> np.ndarray:
    """Frames of it, which take longer to simulate than to look at."""
    return standing().next_frames(FRAMES)


def told(camera: SimulatedCamera, count: int = FRAMES, live: bool = False) -> str:
    """What a recording without a path says in the end."""
    return reason(SENSOR, camera.next_frames(count), live)[-1]


def reason(sensor: Sensor, frames: np.ndarray, live: bool = False) -> list[str]:
    """What is said while the frames come and in the end."""
    reconstructor = Reconstructor(sensor, Options(steps=0), live=live)
    said = []
    for first in range(0, len(frames), 40):
        reconstructor.feed(first, frames[first : first + 40])
        said.append(reconstructor.status().reason)
    reconstructor.finish()
    assert reconstructor.status().state is State.BOOT and not len(reconstructor.trajectory())
    return [*said, reconstructor.status().reason]


def test_a_camera_that_stands_still_hears_that() -> None:
    said = reason(SENSOR, stood())[-1]
    assert said.startswith(NOTHING), said
    assert "record again" in said and "too short" not in said and "move the camera" not in said


def test_a_camera_that_stands_still_in_dim_light_hears_that() -> None:
    assert told(standing(gain=0.12)).startswith(NOTHING)


@pytest.mark.parametrize("velocity", [(0.45, 0.0), (0.06, 0.03), (-0.3, 0.1)])
def test_an_object_that_passes_a_still_camera_is_told(velocity: tuple[float, float]) -> None:
    start = (200.0 if velocity[0] < 0 else 10.0, 60.0)
    said = told(behind(standing(), patch(0.08, start, velocity), float(np.hypot(*velocity))))
    assert said.startswith("the camera stood still and only an object moves ("), said
    assert "record again" in said


def test_an_object_too_fast_to_be_followed_leaves_the_camera_standing() -> None:
    said = told(behind(standing(), patch(0.08, (200.0, 60.0), (-1.2, 0.1)), 1.2))
    assert said.startswith(NOTHING), said


def test_a_short_recording_of_a_moving_camera_is_too_short_not_still() -> None:
    moving = SimulatedCamera(SENSOR, seed=2, motion=MotionKind.ARC, flow_px=0.3, parallax=0.5)
    assert "too short" in told(moving, 80)


def test_a_turning_camera_does_not_stand_still() -> None:
    turning = SimulatedCamera(SENSOR, seed=3, motion=MotionKind.ROTATION)
    said = told(turning, 400)
    assert "parallax" in said and "record again while the camera moves sideways" in said


def test_a_turning_camera_without_a_focal_length_has_no_rough_path() -> None:
    """Through a wrong focal length turning looks like the parallax that would do for one."""
    sensor = replace(SENSOR, intrinsics=Intrinsics.from_fov(SENSOR.width, SENSOR.height, 52.0))
    turning = SimulatedCamera(sensor, seed=3, motion=MotionKind.ROTATION)
    said = reason(replace(sensor, intrinsics=None), turning.next_frames(400))[-1]
    assert "parallax" in said and "record again while the camera moves sideways" in said


def test_who_holds_the_camera_is_told_what_to_do_now_and_in_the_end_what_to_do_again() -> None:
    live, final = (reason(SENSOR, stood(), live=live) for live in (True, False))
    assert any("move the camera sideways" in said for said in live[:-1])
    assert not any("move the camera" in said for said in [*final, live[-1]])
    assert live[-1] == final[-1]
    early = [said for said in final if "views for a first map" in said]
    assert early and not any("record again" in said for said in early), "a recording may have more views"


@pytest.mark.parametrize(
    ("name", "start"),
    [("static_fence", NOTHING), ("car_100kmh", "the camera stood still and only an object moves (18% of the tracks)")],
)
@pytest.mark.parametrize("fov", [None, 60.0])
def test_real_recordings_of_a_camera_that_stood_still(shared: Path, name: str, start: str, fov: float | None) -> None:
    intrinsics = None if fov is None else Intrinsics.from_fov(400, 250, fov)
    recording = open_recording(shared / "real" / f"{name}.dat", width=400, height=250)
    said = reason(replace(recording.sensor, intrinsics=intrinsics), recording.read(0, recording.frames))[-1]
    assert said.startswith(start) and "record again" in said, said


def test_too_few_tracks_say_nothing_about_motion() -> None:
    few = [(np.arange(10), np.random.default_rng(0).random((10, 2)))] * 5
    assert moving_object_share(few) is None and moving_object_share([]) is None
