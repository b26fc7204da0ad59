"""Splats that are removed from the map."""

import numpy as np
import pytest

from spiked.recon.mapping.pruning import Pruning
from spiked.render import Camera, rasteriser_for
from spiked.scene import Scene
from spiked.sensor import Intrinsics

CAMERA = Camera(Intrinsics.from_fov(80, 60, 60), 80, 60)
POSES = [(np.eye(3), np.array([0.1 * n, 0, 0]), 1.8) for n in range(4)]


def splats(means: list[tuple[float, float, float]], size: float = 0.05, logit: float = 3.0) -> Scene:
    """Round grey splats."""
    n = len(means)
    quats = np.tile(np.float32([1, 0, 0, 0]), (n, 1))
    scales = np.full((n, 3), np.log(size), np.float32)
    return Scene(np.array(means, np.float32), quats, scales, np.full(n, logit, np.float32), np.ones((n, 1), np.float32))


WALL = splats([(0.1 * x, 0.1 * y, 2.0) for x in range(-12, 13) for y in range(-8, 9)], size=0.1)


def removed(extra: Scene) -> list[bool]:
    """Which of some splats beside a wall are removed; of the wall none in view is."""
    found = Pruning().needless(WALL.join(extra), rasteriser_for(CAMERA, 1), POSES, 1)
    inside = (np.abs(WALL.means[:, 0]) < 0.8) & (np.abs(WALL.means[:, 1]) < 0.6)
    assert not found[: len(WALL)][inside].any()
    return list(found[len(WALL) :])


def test_a_splat_in_front_of_the_camera_is_removed() -> None:
    assert removed(splats([(0.15, 0.0, 0.3)], size=0.01)) == [True]


def test_a_splat_beside_the_camera_stays_if_it_is_seen_from_elsewhere() -> None:
    assert removed(splats([(0.1, 0.1, 1.95)])) == [False]


def test_a_splat_that_no_view_sees_is_removed() -> None:
    hidden, outside, faint = (0.0, 0.0, 4.0), (5.0, 0.0, 2.0), (0.05, 0.05, 1.9)
    assert removed(splats([hidden, outside])) == [True, True]
    assert removed(splats([faint], size=0.01, logit=-6.0)) == [True]


def test_the_largest_splat_is_a_fraction_of_the_scene() -> None:
    assert Pruning().largest(WALL) == pytest.approx(np.hypot(2.4, 1.6) / 12, rel=0.1)
