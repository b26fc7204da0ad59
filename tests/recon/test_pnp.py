"""The pose of one view from known points, and when it is not trusted."""

import numpy as np

from spiked.pose import exp_so3, log_so3
from spiked.recon import State
from spiked.recon.odometry.pnp import MIN_POINTS, PnPResult, fit_pose
from spiked.recon.odometry.sparse_map import Pose, SparseMap, TrackedView
from spiked.sensor import Intrinsics

K = Intrinsics.from_fov(400, 250, 60)
TRUTH = Pose(exp_so3([0.02, -0.05, 0.01]), np.array([0.04, -0.02, 0.03]))


def seen(points: np.ndarray, noise_px: float = 0.0, strays: int = 0) -> tuple[SparseMap, TrackedView]:
    """A map of the points, and a view of them from `TRUTH`; some of them have moved by 30 px."""
    pixels = K.project((points - TRUTH.centre) @ TRUTH.rotation)
    pixels += np.random.default_rng(1).normal(scale=noise_px, size=pixels.shape) if noise_px else 0
    pixels[:strays] += 30
    view = TrackedView(0, 8.0, 16, np.arange(len(points)), pixels, 1.0, State.TRACK)
    return SparseMap(K, views=[view], points=points), view


def points(count: int) -> np.ndarray:
    return np.random.default_rng(0).uniform([-0.5, -0.3, 0.8], [0.5, 0.3, 2.0], (count, 3))


START = Pose(np.eye(3), np.zeros(3))


def test_exact_tracks_give_the_pose() -> None:
    fit = fit_pose(*seen(points(60)), START)
    assert np.abs(fit.pose.centre - TRUTH.centre).max() < 1e-6
    assert np.abs(log_so3(fit.pose.rotation.T @ TRUTH.rotation)).max() < 1e-6
    assert fit.inliers == 1 and fit.points == 60
    assert fit.lost_reason() is None and fit.degraded_reason(60) is None


def test_a_quarter_of_strays_does_not_move_the_pose() -> None:
    fit = fit_pose(*seen(points(80), noise_px=0.05, strays=20), START)
    assert np.linalg.norm(fit.pose.centre - TRUTH.centre) < 2e-3
    assert fit.inliers == 0.75 and fit.lost_reason() is None


def test_the_predicted_error_is_that_of_repeated_views() -> None:
    """As image displacement at the median depth, of translation and rotation together."""
    sparse_map, view = seen(points(60))
    exact, errors, predicted = view.pixels, [], []
    rng = np.random.default_rng(3)
    grid = np.array([[x, y, 1.4] for x in (-0.5, 0.0, 0.5) for y in (-0.3, 0.0, 0.3)])
    for _ in range(40):
        view.pixels = exact + rng.normal(scale=0.15, size=exact.shape)
        fit = fit_pose(sparse_map, view, START)
        moved = K.project((grid - fit.pose.centre) @ fit.pose.rotation)
        errors.append(moved - K.project((grid - TRUTH.centre) @ TRUTH.rotation))
        predicted.append(fit.sigma_px)
    actual = np.sqrt(np.mean(np.square(errors)))
    assert 0.4 < actual / np.median(predicted) < 2.5, (actual, np.median(predicted))


def test_points_without_a_position_do_not_count() -> None:
    sparse_map, view = seen(points(60))
    sparse_map.points[MIN_POINTS - 1 :] = np.nan
    fit = fit_pose(sparse_map, view, START)
    assert fit.points == MIN_POINTS - 1
    assert "14 known points" in (fit.lost_reason() or "")


def test_reasons_name_the_figure_that_is_wrong() -> None:
    sound = PnPResult(TRUTH, inliers=0.9, points=100, chi2=1.0, sigma_px=0.1)
    assert sound.degraded_reason(tracks=120) is None
    assert "20%" in (sound.degraded_reason(tracks=500) or "")
    assert "1.4 px" in (PnPResult(TRUTH, 0.9, 100, 1.0, 1.4).degraded_reason(120) or "")
    assert "2.0 times" in (PnPResult(TRUTH, 0.9, 100, 4.0, 0.1).degraded_reason(120) or "")
    assert "6 times" in (PnPResult(TRUTH, 0.9, 100, 36.0, 0.1).lost_reason() or "")
    assert "30% agree" in (PnPResult(TRUTH, 0.3, 100, 1.0, 0.1).lost_reason() or "")
