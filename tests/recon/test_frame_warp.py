"""Where the things of each frame lie in an image of one moment."""

import numpy as np

from spiked.pose import exp_so3
from spiked.recon.mapping.frame_warp import FrameWarp
from spiked.render import Camera
from spiked.render.charge import WARP_CELL_PX
from spiked.sensor import Intrinsics

CAMERA = Camera(Intrinsics(90.0, 92.0, 63.0, 41.0), 128, 80)
NORMAL, OFFSET = np.array([0.15, -0.1, 1.0]), 2.0
"""A slanted wall: NORMAL . point = OFFSET."""


def onto(rotation: np.ndarray, centre: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Points of the wall seen at places [n, 2] px."""
    k = CAMERA.intrinsics.matrix()
    rays = np.column_stack([places, np.ones(len(places))]) @ np.linalg.inv(k).T @ rotation.T
    return centre + rays * ((OFFSET - NORMAL @ centre) / (rays @ NORMAL))[:, None]


def seen(rotation: np.ndarray, centre: np.ndarray, points: np.ndarray) -> np.ndarray:
    x = (points - centre) @ rotation @ CAMERA.intrinsics.matrix().T
    return x[:, :2] / x[:, 2:]


def test_places_are_led_to_where_they_are_seen_from_another_pose() -> None:
    rng = np.random.default_rng(0)
    rotation, centre = exp_so3(np.array([0.02, -0.05, 0.1])), np.array([0.1, 0.05, -0.1])
    rotations = np.stack([rotation @ exp_so3(rng.normal(0, 0.02, 3)) for _ in range(6)])
    centres = centre + rng.normal(0, 0.05, (6, 3))
    y, x = np.mgrid[0 : CAMERA.height : 2, 0 : CAMERA.width : 2] + 1.0
    pixels = np.column_stack([x.ravel(), y.ravel()])
    points = onto(rotation, centre, pixels)
    depth = ((points - centre) @ rotation[:, 2]).reshape(x.shape).astype(np.float32)
    depth[3:6, 3:6] = 0  # nothing there: taken to be as far away as the rest
    moved = FrameWarp(np.zeros((6, 1), np.uint8), rotations, centres).displacements(CAMERA, rotation, centre, depth)
    rows, columns = moved.shape[1:3]
    grid = WARP_CELL_PX * np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), -1).reshape(-1, 2).astype(float)
    for r, c, field in zip(rotations, centres, moved, strict=True):
        expected = seen(rotation, centre, onto(r, c, grid)) - grid
        inner = ((expected + grid > 16) & (expected + grid < [CAMERA.width - 16, CAMERA.height - 16])).all(1)
        assert inner.sum() > 50
        error = np.linalg.norm(field.reshape(-1, 2) - expected, axis=1)[inner]
        assert np.median(np.linalg.norm(expected, axis=1)) > 1
        assert np.percentile(error, 90) < 0.15
