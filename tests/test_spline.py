"""The spline passes where it should and its Jacobians are exact."""

from collections.abc import Callable

import numpy as np
import pytest

from spiked.pose import exp_so3, log_so3
from spiked.spline import Spline


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


@pytest.mark.validation
@pytest.mark.parametrize("degree", [1, 3])
def test_knot_gradients_match_finite_differences(degree: int, figure: Callable[[str, object, str], None]) -> None:
    rng = np.random.default_rng(0)
    spline = Spline(0.0, 5.0, exp_so3(0.4 * rng.normal(size=(8, 3))), rng.normal(size=(8, 3)), degree)
    times = np.array([spline.begin + 1.3, spline.begin + 9.2])
    base_rotation, base_centre = spline.poses(times)
    ga, gb = rng.normal(size=(2, 3)), rng.normal(size=(2, 3))

    def loss(moved: Spline) -> float:
        r, c = moved.poses(times)
        return float((ga * log_so3(r @ base_rotation.swapaxes(1, 2))).sum() + (gb * (c - base_centre)).sum())

    rotation, centre = spline.knot_gradients(times, ga, gb)
    step, worst = 1e-6, 0.0
    for knot in range(8):
        for axis in range(3):
            d = np.zeros((8, 3))
            d[knot, axis] = step
            zero = np.zeros_like(d)
            numeric_r = (loss(spline.move(d, zero)) - loss(spline.move(-d, zero))) / (2 * step)
            numeric_c = (loss(spline.move(zero, d)) - loss(spline.move(zero, -d))) / (2 * step)
            worst = max(worst, abs(numeric_r - rotation[knot, axis]), abs(numeric_c - centre[knot, axis]))
    figure(f"Jacobians of a spline of degree {degree}", f"{worst:.1e}", "< 1e-8")
    assert worst < 1e-8
