"""The spline that follows free poses is as coarse as the motion allows, and kinked where that is kinked."""

import numpy as np

from spiked.pose import exp_so3
from spiked.recon.odometry.spline_fitting import MOST_KNOTS, fit_coarsest_spline

TIMES = np.arange(2.0, 322.0, 4.0)
FOCAL_PX = 500.0


def weights(count: int) -> np.ndarray:
    """Hessians of poses that 100 points see, all at depth 1, rotation and translation apart."""
    return np.tile(100 * FOCAL_PX**2 * np.eye(6), (count, 1, 1))


def follow(phi: np.ndarray, centres: np.ndarray, hessians: np.ndarray | None = None) -> object:
    hessians = weights(len(TIMES)) if hessians is None else hessians
    return fit_coarsest_spline(TIMES, exp_so3(phi), centres, hessians, 100 * len(TIMES), (0.0, 322.0))


def noise(rng: np.random.Generator) -> np.ndarray:
    return rng.normal(scale=0.1 / FOCAL_PX, size=(len(TIMES), 3))


def test_slow_motion_needs_few_knots() -> None:
    rng = np.random.default_rng(0)
    phi = 0.05 * np.sin(TIMES / 150)[:, None] * [0.3, 1.0, 0.1]
    spline = follow(phi + noise(rng), phi[:, ::-1] + noise(rng))
    assert spline.degree == 3 and spline.spacing >= 64


def test_kinks_are_found_with_their_phase() -> None:
    rng = np.random.default_rng(1)
    corners = np.cumsum(rng.normal(scale=8 / FOCAL_PX, size=(46, 3)), 0)
    phi = np.stack([np.interp(TIMES, 8.0 * np.arange(46) - 8, corners[:, i]) for i in range(3)], 1)
    spline = follow(phi + 0.1 * noise(rng), 0 * phi)
    assert spline.degree == 1 and spline.spacing == 8
    assert abs(((spline.begin + 4) % 8) - 4) < 1e-3, "knots lie on the kinks"


def test_a_direction_that_was_hardly_seen_does_not_pull() -> None:
    rng = np.random.default_rng(2)
    phi = 0.05 * np.sin(TIMES / 150)[:, None] * [0.3, 1.0, 0.1]
    hessians = weights(len(TIMES))
    hessians[:, 3, 3] *= 1e-4
    wild = phi[:, ::-1] + noise(rng)
    wild[:, 0] += rng.normal(scale=3 / FOCAL_PX, size=len(TIMES))
    spline = follow(phi + noise(rng), wild, hessians)
    assert spline.spacing >= 32


def test_a_path_of_a_minute_has_a_bounded_number_of_knots() -> None:
    """A live capture with a long gap once took minutes and gigabytes here."""
    times = np.concatenate([TIMES, TIMES + 1_200_000.0])
    phi = 0.05 * np.sin(times / 150)[:, None] * [0.3, 1.0, 0.1]
    spline = fit_coarsest_spline(times, exp_so3(phi), phi, weights(len(times)), 100 * len(times), (0.0, 1_200_322.0))
    assert len(spline.centres) <= MOST_KNOTS + 4
