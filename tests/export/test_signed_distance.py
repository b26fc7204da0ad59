"""The compiled sums of signed distances are those of the camera model in Python."""

import numpy as np
import pytest
import spiked.native._dense as _dense

from spiked.distortion import Distortion, LensModel
from spiked.pose import exp_so3
from spiked.sensor import Intrinsics

SIDE, STEP, REACH = 4, 0.11, 0.3


@pytest.mark.parametrize(
    "lens",
    [
        None,
        Distortion(LensModel.OPENCV, (-0.2, 0.05, 0.002, -0.001, 0.0)),
        Distortion(LensModel.FISHEYE, (0.02, 0, 0, 0)),
    ],
)
def test_distances_are_those_of_the_camera_model(lens: Distortion | None) -> None:
    random = np.random.default_rng(4)
    optics = Intrinsics(30.0, 31.0, 20.5, 14.2, lens)
    depth = random.uniform(0.5, 3, (29, 41)).astype(np.float32)
    depth[random.random(depth.shape) < 0.2] = 0
    rotation, centre = exp_so3(np.array([0.2, -0.3, 0.1])), np.array([0.1, 0.2, -0.4])
    corners = random.uniform(-2, 2, (300, 3))
    total, seen = np.zeros((300, SIDE**3), np.float32), np.zeros((300, SIDE**3), np.int32)
    focal = np.array([optics.fx, optics.fy, optics.cx, optics.cy])
    for _ in range(2):  # they add up
        _dense.add_distances(corners, STEP, SIDE, depth, rotation, centre, focal, REACH, total, seen, **optics.lens())
    within = np.stack(np.meshgrid(*(np.arange(SIDE),) * 3, indexing="ij"), -1).reshape(-1, 3)
    local = (corners[:, None] + (within + 0.5) * STEP - centre) @ rotation
    x, y = np.moveaxis(np.floor(optics.project(local)).astype(int), -1, 0)
    inside = (local[..., 2] > 0) & (x >= 0) & (y >= 0) & (x < 41) & (y < 29)
    shown = np.where(inside, depth[np.where(inside, y, 0), np.where(inside, x, 0)], 0)
    signed = shown - local[..., 2]
    counts = (shown > 0) & (signed > -REACH)
    assert counts.sum() > 500
    np.testing.assert_array_equal(seen, 2 * counts)
    np.testing.assert_allclose(total, np.where(counts, 2 * np.minimum(signed / REACH, 1), 0), atol=1e-5)


def test_arrays_of_other_shapes_are_refused() -> None:
    one = (np.zeros((2, 3)), STEP, SIDE, np.zeros((3, 3), np.float32), np.eye(3), np.zeros(3), np.ones(4), REACH)
    with pytest.raises(ValueError, match="each block"):
        _dense.add_distances(*one, np.zeros((1, 64), np.float32), np.zeros((2, 64), np.int32))
    with pytest.raises(ValueError, match="voxel of a block"):
        _dense.add_distances(*one, np.zeros((2, 63), np.float32), np.zeros((2, 64), np.int32))
