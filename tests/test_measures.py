"""Metres by a board or a rig of two cameras, and up by gravity or the floor."""

import numpy as np
import pytest
from tag_card import BOARD, SQUARE_M, board_card, card_scene

from spiked.baseline_scale import scale_by_baseline
from spiked.board import Board
from spiked.board_scale import scale_by_board
from spiked.errors import ConfigurationError, SceneError
from spiked.pose import exp_so3
from spiked.scene import Scene
from spiked.trajectory import Trajectory
from spiked.upright import find_floor, up_by_gravity, up_by_points

from .room_map import UP, room_map


def angle_deg(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip(one @ other, -1, 1))))


def test_a_board_of_known_squares_gives_metres() -> None:
    found = scale_by_board(*card_scene(board_card()), BOARD, SQUARE_M)
    assert found.metres_per_unit == pytest.approx(1.0, abs=3e-3)  # the room is in metres
    assert found.views >= 40 and 18 <= found.corners <= 24
    assert abs(found.metres_per_unit - 1) < 5 * found.sigma + 1e-3


def test_a_scene_without_the_board_says_so() -> None:
    scene, path, camera = card_scene(board_card())
    with pytest.raises(SceneError, match="the board is in 0 of the pictures"):
        scale_by_board(scene, path, camera, Board(9, 6, "5x5_100"), SQUARE_M)
    with pytest.raises(ConfigurationError, match="positive"):
        scale_by_board(scene, path, camera, BOARD, 0.0)


def rig(distance: float, offset_s: float, noise: float = 0.0) -> tuple[Trajectory, Trajectory]:
    """The paths of two cameras at a distance; times count from the first frame of each."""
    times = np.linspace(0.0, 1.0, 201)
    turns = exp_so3(np.stack([0.3 * np.sin(4 * times), 0.2 * times, 0.1 * np.cos(times)], axis=1))
    centres = np.stack([np.sin(3 * times), times, 0.2 * times**2], axis=1)
    rng = np.random.default_rng(0)
    second = centres + turns @ [distance, 0, 0] + noise * rng.standard_normal((len(times), 3))
    late = times >= offset_s
    return Trajectory(times, turns, centres), Trajectory(times[late] - offset_s, turns[late], second[late])


def test_a_rig_of_two_cameras_gives_metres() -> None:
    found = scale_by_baseline(*rig(0.4, 0.25), baseline_m=0.12, offset_s=0.25)
    assert found.metres_per_unit == pytest.approx(0.3, rel=1e-6) and found.sigma < 1e-3 and found.poses == 151
    noisy = scale_by_baseline(*rig(0.4, 0.25, 0.004), baseline_m=0.12, offset_s=0.25)
    assert abs(noisy.metres_per_unit / 0.3 - 1) < noisy.sigma and 0.005 < noisy.sigma < 0.03


def test_cameras_that_are_no_rig_are_refused() -> None:
    with pytest.raises(SceneError, match="not on one rig"):
        scale_by_baseline(*rig(0.4, 0.25), baseline_m=0.12, offset_s=-0.5)
    with pytest.raises(SceneError, match="moments only"):
        scale_by_baseline(*rig(0.4, 0.25), baseline_m=0.12, offset_s=7.0)
    with pytest.raises(ConfigurationError, match="positive"):
        scale_by_baseline(*rig(0.4, 0.25), baseline_m=-1.0)


def test_gravity_in_the_camera_is_turned_into_the_scene() -> None:
    rotation = exp_so3(np.array([0.4, -0.7, 0.2]))
    np.testing.assert_allclose(up_by_gravity(9.81 * rotation.T @ -UP, rotation), UP, atol=1e-12)
    with pytest.raises(ConfigurationError, match="a direction is needed"):
        up_by_gravity([0.0, 0.0, 0.0], rotation)


def test_points_of_the_floor_give_up_towards_the_cameras() -> None:
    points = np.array([[0.0, 0.0, 1.0], [2.0, 0.0, 1.0], [0.0, 3.0, 1.0]])
    np.testing.assert_allclose(up_by_points(points, np.array([[0.0, 0.0, 2.0]])), UP, atol=1e-12)
    np.testing.assert_allclose(up_by_points(points[::-1], np.array([[0.0, 0.0, -2.0]])), -UP, atol=1e-12)
    with pytest.raises(ConfigurationError, match="on a line"):
        up_by_points(np.outer([0.0, 1.0, 2.0], [1.0, 1.0, 0.0]), np.zeros((1, 3)))
    with pytest.raises(ConfigurationError, match="three points"):
        up_by_points(points[:2], np.zeros((1, 3)))


@pytest.mark.parametrize("seed", [2, 3])
def test_the_floor_of_the_room_is_found_below_its_tables(seed: int) -> None:
    room = room_map(seed, (0.0, 0.4))
    floor = find_floor(room.scene, room.path)
    assert angle_deg(floor.up, UP) < 1.0
    assert 0.03 < floor.share < 0.6


def test_a_scene_without_a_floor_says_so() -> None:
    room = room_map(2, (0.0,))
    wall = room.scene.select(np.flatnonzero(room.scene.means[:, 2] > 1.0))  # nothing below the cameras but walls
    with pytest.raises(SceneError, match="no floor"):
        find_floor(wall, room.path)
    with pytest.raises(SceneError, match="splats"):
        find_floor(Scene.empty(1), room.path)


@pytest.mark.parametrize("splats", [17, 30, 60])
def test_a_scene_of_few_splats_has_no_floor(splats: int) -> None:
    room = room_map(2, (0.0,))
    rng = np.random.default_rng(0)
    for _ in range(20):
        few = room.scene.select(rng.permutation(len(room.scene))[:splats])
        with pytest.raises(SceneError, match="no floor is seen"):
            find_floor(few, room.path)


def test_splats_on_a_line_are_no_floor() -> None:
    room = room_map(2, (0.0,))
    line = room.scene.select(np.arange(400))
    line.means[:] = np.linspace(-2, 2, 400, dtype=np.float32)[:, None] * [1, 0, 0]
    with pytest.raises(SceneError, match="no floor is seen"):
        find_floor(line, room.path)
