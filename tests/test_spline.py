"""The spline passes where it should."""

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
