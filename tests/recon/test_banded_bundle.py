"""The banded adjustment is the dense one, also where the path closes a loop."""

from dataclasses import replace

import numpy as np
import pytest

from spiked.pose import exp_so3
from spiked.recon.odometry import banded_bundle
from spiked.recon.odometry.bundle_adjustment import Bundle
from spiked.recon.odometry.normal_equations import FreeOptics
from spiked.sensor import Intrinsics

OPTICS = [FreeOptics(focal, radial) for radial in (False, True) for focal in (False, True)]
POSES, POINTS, WAY, NOISE_PX, SCALE_PX = 40, 800, 15.0, 0.05, 0.5


def sideways(loop: bool, free: FreeOptics = FreeOptics()) -> Bundle:  # noqa: B008
    """Poses along a wall, with errors; with a `loop` the last ones see what the first ones saw."""
    rng = np.random.default_rng(0)
    intrinsics = Intrinsics.from_fov(400, 250, 60)
    way = np.linspace(0, WAY, POSES)
    if loop:
        way = WAY * np.sin(np.pi * np.arange(POSES) / (POSES - 1))
    centres = np.stack([way, 0.1 * np.sin(way), np.zeros(POSES)], 1)
    places = np.stack([rng.uniform(-2, WAY + 2, POINTS), rng.uniform(-1, 1, POINTS), rng.uniform(2, 4, POINTS)], 1)
    pixels = intrinsics.project((places[None] - centres[:, None]).reshape(-1, 3)).reshape(POSES, POINTS, 2)
    seen = ((pixels > 0) & (pixels < [400, 250])).all(2)
    seen &= seen.sum(0) >= 3
    camera, point = np.nonzero(seen)
    known, point = np.unique(point, return_inverse=True)
    return Bundle(
        exp_so3(0.002 * rng.standard_normal((POSES, 3))),
        centres + 0.01 * rng.standard_normal(centres.shape),
        (places + 0.02 * rng.standard_normal(places.shape))[known],
        camera,
        point,
        pixels[seen] + NOISE_PX * rng.standard_normal((int(seen.sum()), 2)),
        replace(intrinsics, fx=1.02 * intrinsics.fx, fy=1.02 * intrinsics.fy) if free.focal else intrinsics,
        free,
    )


@pytest.mark.parametrize("loop", [False, True], ids=["open", "loop"])
@pytest.mark.parametrize("free", OPTICS, ids=["", "focal", "lens", "both"])
def test_it_is_the_dense_adjustment(loop: bool, free: FreeOptics) -> None:
    dense, banded = sideways(loop, free), sideways(loop, free)
    fixed = np.arange(POSES) < 2
    cost = dense.optimise(4, SCALE_PX, fixed)
    assert banded_bundle.optimise(banded, 4, SCALE_PX, fixed) == pytest.approx(cost, rel=1e-6)
    np.testing.assert_allclose(banded.centres, dense.centres, atol=1e-7)
    np.testing.assert_allclose(banded.points, dense.points, atol=1e-6)
    assert banded.intrinsics.fx == pytest.approx(dense.intrinsics.fx, rel=1e-7)
    if free.radial:
        assert banded.intrinsics.distortion is not None and dense.intrinsics.distortion is not None
        assert banded.intrinsics.distortion.coefficients == pytest.approx(
            dense.intrinsics.distortion.coefficients, abs=1e-7
        )


def test_the_band_is_narrow_on_an_open_path_and_in_a_loop() -> None:
    widths = []
    for loop in (False, True):
        bundle = sideways(loop)
        structure = banded_bundle.BandedStructure.of(bundle, np.ones(POSES, bool))
        assert sorted(structure.order.tolist()) == list(range(POSES))
        widths.append(structure.bandwidth)
    assert widths[0] < 0.5 * 6 * POSES  # a pose shares points with a third of the others
    assert widths[1] < 0.9 * 6 * POSES


def test_poses_that_are_fixed_stay() -> None:
    bundle = sideways(loop=False)
    fixed = np.isin(np.arange(POSES), [0, 1, 17])
    before = bundle.centres.copy()
    banded_bundle.optimise(bundle, 3, SCALE_PX, fixed)
    np.testing.assert_array_equal(bundle.centres[fixed], before[fixed])
    assert np.abs(bundle.centres[~fixed] - before[~fixed]).max() > 1e-4
