"""A camera that is covered while it turns away is tracked in a second map, until a known place is seen again."""

import pickle

import numpy as np
import pytest

from spiked.evaluate import score_trajectory
from spiked.recon import Options, Reconstructor, State
from spiked.simulate import SimulatedCamera
from spiked.simulate.motion import hand_shake
from spiked.simulate.room import Room
from spiked.trajectory import Trajectory

from .test_long_path import SENSOR, ThereAndBack

FRAMES = 8000
COVERED = range(1500, 2800)
"""The camera turns by 0.6 rad before and by 1.5 rad until after it; what it then sees was never seen."""
BLOCK = 50


def camera() -> SimulatedCamera:
    assert SENSOR.intrinsics is not None
    stage = Room(colour=False, seed=2).stage(SENSOR.intrinsics, flow_px=0.02, parallax=0.01)
    motion = ThereAndBack(stage, hand_shake(stage, seed=3), FRAMES)
    return SimulatedCamera(SENSOR, seed=2, motion=motion, step_px=0.3)


@pytest.fixture(scope="module")
def frames() -> np.ndarray:
    """Stored frames of the whole path, dark while the camera is covered."""
    seen = np.concatenate([camera().next_frames(FRAMES)])
    seen[COVERED.start : COVERED.stop] = 0
    return seen


def feed(reconstructor: Reconstructor, frames: np.ndarray, begin: int, end: int) -> None:
    for first in range(begin, end, BLOCK):
        reconstructor.feed(first, frames[first : first + BLOCK])


def score(reconstructor: Reconstructor, end: int) -> tuple[float, float]:
    """Share of the frames that could be seen and have a pose, and ATE in percent."""
    rotations, centres = camera().truth(np.arange(end))
    truth = Trajectory((np.arange(end) + 0.5) / SENSOR.frame_rate_hz, rotations, centres)
    found = score_trajectory(truth=truth, estimate=reconstructor.trajectory(), frame_rate_hz=SENSOR.frame_rate_hz)
    assert found.errors is not None
    return found.coverage * end / (end - len(COVERED)), found.errors.ate_percent


@pytest.fixture(scope="module")
def returned(frames: np.ndarray) -> Reconstructor:
    """All frames tracked, with a copy of all by a checkpoint's means while there are two maps."""
    reconstructor = Reconstructor(SENSOR, Options(steps=0))
    feed(reconstructor, frames, 0, 4500)
    assert reconstructor.odometry.state is State.LOST
    assert "have a pose in a second map: it is joined once" in reconstructor.odometry.reason
    reconstructor = pickle.loads(pickle.dumps(reconstructor))
    feed(reconstructor, frames, 4500, FRAMES)
    return reconstructor


def test_a_second_map_is_joined_when_a_known_place_is_seen_again(returned: Reconstructor) -> None:
    odometry = returned.odometry
    joined = [reason for _, state, reason in odometry.changes if state is State.RELOC]
    assert len(joined) == 1 and "views of a second map are joined" in joined[0]
    odometry.end()
    assert odometry.remark is None and odometry.state is State.TRACK
    assert len(odometry.closures) >= 3
    assert all(earlier < COVERED.start and later > COVERED.stop for earlier, later in odometry.closures[:3])
    coverage, ate_percent = score(returned, FRAMES)
    assert coverage > 0.95
    assert ate_percent < 3


def test_a_path_that_never_returns_has_the_longer_map(frames: np.ndarray) -> None:
    for end, longer in ((3700, "first"), (5200, "second")):
        reconstructor = Reconstructor(SENSOR, Options(steps=0))
        feed(reconstructor, frames, 0, end)
        reconstructor.odometry.end()
        posed = [view.time for view in reconstructor.odometry.views if view.pose is not None]
        assert (max(posed) < COVERED.stop) == (longer == "first")
        assert (min(posed) > COVERED.start) == (longer == "second")
        remark = reconstructor.odometry.remark
        assert remark is not None and "belong to a second map" in remark and "have no pose" in remark
        assert score(reconstructor, end)[1] < 3


def test_splats_of_a_map_that_is_given_up_are_removed(frames: np.ndarray) -> None:
    reconstructor = Reconstructor(SENSOR, Options(steps=0), live=True)
    feed(reconstructor, frames, 0, 1400)
    reconstructor.improve(0.01)
    assert len(reconstructor.trainer.mapper) > 100
    feed(reconstructor, frames, 1400, 5200)
    reconstructor.end_tracking()
    assert reconstructor.odometry.remark is not None
    assert reconstructor.odometry.views[0].pose is None and len(reconstructor.trajectory()) > 0
    assert len(reconstructor.trainer.mapper) == 0


def test_a_recording_may_end_when_the_second_map_has_no_view_yet(frames: np.ndarray) -> None:
    reconstructor = Reconstructor(SENSOR, Options(steps=0))
    at = 0
    while reconstructor.odometry._second is None:
        feed(reconstructor, frames, at, at + BLOCK)
        at += BLOCK
        assert at < 3000
    assert len(reconstructor.odometry._second.views) == len(reconstructor.odometry.views)
    reconstructor.odometry.end()
    assert sum(view.pose is not None for view in reconstructor.odometry.views) > 100
