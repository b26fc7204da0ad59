"""Each kind of path does what its name says, and is a valid pose at any time."""

import numpy as np
import pytest

from spiked.pose import log_so3
from spiked.simulate import MotionKind, Stage, look_at, make_motion
from spiked.simulate.motion import Recorded

STAGE = Stage(np.array([1.0, 2.0, 1.5]), np.array([1.0, 5.0, 1.0]), np.array([0.0, 0.0, 1.0]), 346.0)


def test_looking_at_a_point_puts_it_ahead_and_up_upwards() -> None:
    rotation = look_at([0, 0, 1], [3, 4, 1], [0, 0, 1])
    assert np.allclose(rotation.T @ [0.6, 0.8, 0], [0, 0, 1])
    assert np.allclose(rotation.T @ [0, 0, 1], [0, -1, 0])
    assert np.linalg.det(rotation) == pytest.approx(1)


@pytest.mark.parametrize("kind", MotionKind)
def test_poses_are_rotations_and_repeatable(kind: MotionKind) -> None:
    times = np.array([0.0, 0.5, 17.25, 1e5])
    rotations, centres = make_motion(kind, STAGE, 3).poses(times)
    assert np.allclose(rotations @ rotations.swapaxes(1, 2), np.eye(3))
    assert np.all(np.linalg.det(rotations) > 0)
    again = make_motion(kind, STAGE, 3).poses(times[2:])
    assert np.array_equal(again[0], rotations[2:]) and np.array_equal(again[1], centres[2:])
    assert not np.array_equal(make_motion(kind, STAGE, 4).poses(times)[0], rotations)


@pytest.mark.parametrize("seed", range(5))
def test_a_hand_shakes_as_fast_and_as_far_as_asked(seed: int) -> None:
    rotations, centres = make_motion(MotionKind.HAND_SHAKE, STAGE, seed).poses(np.arange(20000.0))
    turn = log_so3(rotations[:-1].swapaxes(1, 2) @ rotations[1:])
    speed_px = 346 * np.sqrt((turn**2).sum(1).mean())
    assert 0.08 < speed_px < 0.16
    path = np.linalg.norm(np.diff(centres, axis=0), axis=1).sum() / (20000 / 1280) / STAGE.depth
    assert 0.05 < path < 0.15
    jerk = np.abs(np.diff(turn, axis=0)).max() * 346
    assert jerk < 0.01


def test_a_camera_that_only_turns_stays_where_it_is() -> None:
    _, centres = make_motion(MotionKind.ROTATION, STAGE).poses(np.arange(0.0, 5000.0, 10.0))
    assert np.all(centres == STAGE.centre)


def test_a_camera_stands_still_before_it_moves() -> None:
    rotations, centres = make_motion(MotionKind.STAND_THEN_MOVE, STAGE).poses(np.arange(0.0, 1000.0))
    assert np.all(centres[:321] == centres[0]) and np.all(rotations[:321] == rotations[0])
    assert np.linalg.norm(centres[-1] - centres[0]) > 0.01


def test_a_kinked_path_is_straight_for_eight_frames_and_kinked_after() -> None:
    _, centres = make_motion(MotionKind.KINKED, STAGE).poses(np.arange(0.0, 161.0))
    bend = np.linalg.norm(np.diff(centres, 2, axis=0), axis=1)
    kinks = np.arange(len(bend)) % 8 == 7
    assert bend[~kinks].max() < 1e-12
    assert bend[kinks].min() > 1e-6


def test_an_arc_keeps_its_distance_and_forward_motion_nears_the_target() -> None:
    _, centres = make_motion(MotionKind.ARC, STAGE).poses(np.arange(0.0, 1281.0, 64.0))
    assert np.linalg.norm(centres - STAGE.target, axis=1) == pytest.approx(STAGE.depth, rel=0.05)
    _, centres = make_motion(MotionKind.FORWARD, STAGE).poses(np.array([0.0, 1280.0]))
    assert (centres[1] - centres[0]) @ STAGE.rotation[:, 2] > 0.05 * STAGE.depth


def test_a_recorded_path_passes_its_poses_and_rests_beyond_them() -> None:
    times = np.array([0.5, 1.5, 4.0])
    rotations, centres = make_motion(MotionKind.HAND_SHAKE, STAGE).poses(100 * times)
    path = Recorded(times, rotations, centres)
    assert np.allclose(path.poses(times)[0], rotations) and np.allclose(path.poses(times)[1], centres)
    assert np.allclose(path.poses([2.75])[1], (centres[1] + centres[2]) / 2)
    assert np.allclose(path.poses([-3.0, 99.0])[1], centres[[0, 2]])
