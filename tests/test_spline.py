"""The spline passes where it should."""

import numpy as np
import pytest

from spiked.pose import exp_so3, log_so3
from spiked.spline import DENSE_KNOTS, Spline, Waypoints


def wavy(times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    phi = np.stack([0.1 * np.sin(times / 40), 0.08 * np.cos(times / 55), 0.002 * times], 1)
    return exp_so3(phi), np.stack([np.sin(times / 60), 0.01 * times, np.cos(times / 70)], 1)


@pytest.mark.parametrize(("degree", "tolerance"), [(1, 5e-3), (3, 1e-4)])
def test_fit_follows_a_smooth_path(degree: int, tolerance: float) -> None:
    times = np.arange(200) + 0.5
    rotations, centres = wavy(times)
    got_rotations, got_centres = Spline.fit(times, rotations, centres, 8, degree).poses(times)
    assert np.abs(got_centres - centres).max() < tolerance
    assert np.abs(log_so3(got_rotations @ rotations.swapaxes(1, 2))).max() < tolerance


def test_the_path_continues_at_constant_velocity_outside() -> None:
    times = np.arange(10.0)
    spline = Spline.fit(times, np.tile(np.eye(3), (10, 1, 1)), times[:, None] * [1.0, 0, 0], 4)
    assert spline.begin <= 0 and spline.end >= 9
    np.testing.assert_allclose(spline.poses([0.0, 9.0])[1][:, 0], [0, 9], atol=1e-3)


@pytest.mark.parametrize("degree", [1, 3])
def test_long_paths_are_fitted_as_short_ones(degree: int, monkeypatch: pytest.MonkeyPatch) -> None:
    times = np.sort(np.random.default_rng(0).uniform(0, 2000, 1500))
    times = times[(times < 700) | (times > 800)]  # a gap of twelve knots
    rotations, centres = wavy(times)
    dense = Spline.fit(times, rotations, centres, 8, degree)
    monkeypatch.setattr("spiked.spline.DENSE_KNOTS", 0)
    banded = Spline.fit(times, rotations, centres, 8, degree)
    np.testing.assert_allclose(banded.centres, dense.centres, atol=1e-6)
    np.testing.assert_allclose(banded.rotations, dense.rotations, atol=1e-6)


def test_a_path_of_a_minute_at_20_khz_is_fitted() -> None:
    times = np.arange(0, 1_200_000, 4) + 0.5
    rotations, centres = wavy(times / 400)
    spline = Spline.fit(times, rotations, centres, 8)
    assert len(spline.centres) > 100 * DENSE_KNOTS
    got_rotations, got_centres = spline.poses(times[::1000])
    np.testing.assert_allclose(got_centres, centres[::1000], atol=1e-5)
    np.testing.assert_allclose(got_rotations, rotations[::1000], atol=1e-5)


def trembling(times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A hand at 8 Hz, in frames of 20 kHz."""
    phase = 2 * np.pi * 8 / 20_000 * times
    turns = np.stack([0.01 * np.sin(phase), 0.01 * np.cos(phase), 1e-4 * times], 1)
    return exp_so3(turns), np.stack([0.02 * np.cos(phase), 0.01 * np.sin(2 * phase), 1e-4 * times], 1)


def test_smooth_waypoints_follow_a_hand_that_trembles() -> None:
    rng = np.random.default_rng(0)
    known = np.cumsum(rng.uniform(200, 500, 60))
    between = np.arange(known[2], known[-3], 37.0)
    rotations, centres = trembling(between)
    errors = []
    for smooth in (False, True):
        path = Waypoints(known, *trembling(known), smooth)
        for got, given in zip(path.poses(known), trembling(known), strict=True):
            np.testing.assert_allclose(got, given, atol=1e-9)
        got_rotations, got_centres = path.poses(between)
        turned = np.linalg.norm(log_so3(got_rotations @ rotations.swapaxes(1, 2)), axis=1)
        errors.append((np.sqrt((turned**2).mean()), np.sqrt(((got_centres - centres) ** 2).sum(1).mean())))
    straight, curved = errors
    assert curved[0] < straight[0] / 1.6 and curved[1] < straight[1] / 1.6


def test_smooth_waypoints_are_about_straight_over_a_long_space() -> None:
    """Views of a few frames in a row, each a little off, then one much later: their speed says nothing about it."""
    rng = np.random.default_rng(0)
    known = np.concatenate([np.arange(0.0, 320, 16), np.arange(6000.0, 9000, 300)])
    rotations, centres = trembling(np.full(len(known), 10.0))
    rotations = exp_so3(rng.normal(0, 1e-3, (len(known), 3))) @ rotations
    path, straight = (Waypoints(known, rotations, centres, smooth) for smooth in (True, False))
    inside = np.linspace(305, 5999, 50)
    turned = log_so3(path.poses(inside)[0] @ straight.poses(inside)[0].swapaxes(1, 2))
    assert 0 < np.abs(turned).max() < 3e-3


def test_few_smooth_waypoints_are_a_path() -> None:
    for count in (1, 2, 3, 4):
        known = 300.0 * np.arange(count)
        rotations, centres = trembling(known)
        path = Waypoints(known, rotations, centres, smooth=True)
        got = path.poses([-50.0, known[-1] / 2, known[-1] + 50])
        assert np.isfinite(got[0]).all() and np.isfinite(got[1]).all()
        np.testing.assert_allclose(got[1][[0, 2]], centres[[0, -1]], atol=1e-9)
