"""Paths of a video: where the camera is, and how it moves."""

import numpy as np
import pytest

from spiked.errors import SceneError
from spiked.pose import exp_so3, log_so3
from spiked.trajectory import Trajectory
from spiked.video import recorded_path, smoothed_path, waypoint_path


def walk(poses: int, tremor: float = 0.0) -> Trajectory:
    """Half a circle in two seconds, with a tremor of 10 Hz."""
    times = np.linspace(5.0, 7.0, poses)
    turn = np.pi * (times - 5) / 2
    shake = tremor * np.sin(2 * np.pi * 10 * times)
    centres = np.stack([np.cos(turn), shake, np.sin(turn)], -1)
    return Trajectory(times, exp_so3(np.stack([shake, -turn, 0 * turn], -1)), centres)


def test_the_recorded_path_is_what_was_recorded() -> None:
    path = walk(41, tremor=0.02)
    rotations, centres = recorded_path(path).sampled(41)
    np.testing.assert_allclose(centres, path.centres, atol=1e-12)
    np.testing.assert_allclose(rotations, path.rotations, atol=1e-9)


def test_smoothing_takes_the_tremor_and_keeps_the_way() -> None:
    rotations, centres = smoothed_path(walk(2000, tremor=0.02)).sampled(200)
    still_rotations, still = recorded_path(walk(2000)).sampled(200)
    off = np.linalg.norm(centres - still, axis=1)
    assert off[10:-10].max() < 0.002 and off.max() < 0.015
    turned = np.linalg.norm(log_so3(rotations @ still_rotations.swapaxes(1, 2)), axis=1)
    assert turned[10:-10].max() < 0.002 and turned.max() < 0.015
    jerk = np.linalg.norm(np.diff(centres, 3, axis=0), axis=1).max()
    shaken = np.linalg.norm(np.diff(recorded_path(walk(2000, tremor=0.02)).sampled(200)[1], 3, axis=0), axis=1).max()
    assert jerk < shaken / 50


def test_waypoints_are_met_without_a_stop_or_a_kink() -> None:
    some = walk(5)
    path = waypoint_path(some)
    rotations, centres = path.sampled(401)
    np.testing.assert_allclose(centres[::100], some.centres, atol=2e-3)
    assert np.linalg.norm(log_so3(rotations[::100] @ some.rotations.swapaxes(1, 2)), axis=1).max() < 2e-3
    speed = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    assert speed.min() > 0.5 * speed.max()
    assert np.abs(np.diff(speed)).max() < 0.05 * speed.max()


def test_two_waypoints_are_a_straight_way() -> None:
    _, centres = waypoint_path(walk(2)).sampled(11)
    np.testing.assert_allclose(centres[:, 0], np.linspace(1, -1, 11), atol=1e-3)


def test_paths_without_poses_are_refused() -> None:
    with pytest.raises(SceneError, match="0 poses, and a video needs 1"):
        recorded_path(walk(0))
    with pytest.raises(SceneError, match="1 poses, and a video needs 2"):
        waypoint_path(walk(1))
    with pytest.raises(SceneError, match="3 poses, and a video needs 4"):
        smoothed_path(walk(3))
    with pytest.raises(SceneError, match="501 poses are too many"):
        waypoint_path(walk(501))
    still = walk(4)
    with pytest.raises(SceneError, match="all of one time"):
        smoothed_path(Trajectory(np.full(4, 5.0), still.rotations, still.centres))


def test_one_pose_is_a_still_picture() -> None:
    _, centres = recorded_path(walk(1)).sampled(3)
    assert (centres == walk(1).centres[0]).all()
