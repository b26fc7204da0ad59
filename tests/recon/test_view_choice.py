"""The views of a long path that the map is fitted to."""

import numpy as np

from spiked.recon.odometry.sparse_map import Pose, TrackedView
from spiked.recon.odometry.tracking_state import State
from spiked.recon.view_choice import MOST_VIEWS_OF_A_CELL, choose

FOCAL_PX = 300.0
WALL = np.stack([*(g.ravel() for g in np.meshgrid(np.arange(-1, 18, 0.05), np.arange(-0.5, 0.5, 0.05)))], 1)
POINTS = np.column_stack([WALL, np.full(len(WALL), 2.0)])
"""A wall at a distance of 2, seen by a camera that moves along it."""


def view(number: int, x: float, motion_px: float = 0.1) -> TrackedView:
    ids = np.flatnonzero(np.abs(POINTS[:, 0] - x) < 0.5)
    pose = Pose(np.eye(3), np.array([x, 0.0, 0.0]))
    return TrackedView(number, 64.0 * number, 64, ids, np.zeros((len(ids), 2)), motion_px, State.TRACK, pose)


def chosen(places: list[float], most: int) -> list[int]:
    return choose([view(number, x) for number, x in enumerate(places)], POINTS, FOCAL_PX, most)


def test_views_that_are_few_are_all_chosen_where_each_adds_surface() -> None:
    assert chosen([0.1 * number for number in range(100)], 200) == list(range(100))


def test_standing_still_adds_none() -> None:
    moving = [0.02 * number for number in range(200)]
    rest = [moving[-1]] * 500
    without, with_rest = chosen(moving, 400), chosen(moving + rest, 400)
    assert with_rest[: len(without)] == without
    assert len(with_rest) - len(without) <= MOST_VIEWS_OF_A_CELL
    assert chosen(moving + 2 * rest, 400) == with_rest


def test_a_second_round_through_the_same_place_adds_little() -> None:
    once = [0.02 * number for number in range(400)]
    again = np.array(chosen(once + once, 40)) >= 400
    further = np.array(chosen(once + [8 + x for x in once], 40)) >= 400
    assert again.mean() < 0.1 and 0.4 < further.mean() < 0.6


def test_views_are_no_more_than_asked_for_and_cover_the_whole_path() -> None:
    places = [0.02 * number for number in range(800)]
    for most in (5, 60):
        ids = chosen(places, most)
        assert 0.3 * most <= len(ids) <= most and ids == sorted(set(ids))
        assert max(np.diff([0, *ids, 800])) < 3 * 800 / len(ids)


def test_of_views_of_the_same_place_the_sharper_ones_are_chosen() -> None:
    views = [view(number, 0.001 * (number % 100), 5.0 if number < 100 else 0.1) for number in range(200)]
    ids = choose(views, POINTS, FOCAL_PX, 8)
    assert ids and min(ids) >= 100


def test_without_known_points_none_is_chosen() -> None:
    assert choose([], POINTS, FOCAL_PX, 8) == []
    assert choose([view(0, 0.0)], np.full_like(POINTS, np.nan), FOCAL_PX, 8) == []
