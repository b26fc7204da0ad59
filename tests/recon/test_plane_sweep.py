"""The plane sweep: pictures of known places give their depth back."""

import numpy as np
import pytest
import spiked.native._dense as _dense

from spiked.recon.mapping.depth_sweeps import _filled
from spiked.recon.mapping.plane_sweep import PosedImage, Sweep, sweep
from spiked.sensor import Intrinsics

K = Intrinsics(120.0, 120.0, 80.0, 50.0)
SIZE = (100, 160)


def textured(centre: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """A wall of that depth [H, W] (as the camera at the origin sees it), seen from `centre`, without rotation."""
    v, u = np.mgrid[: SIZE[0], : SIZE[1]] + 0.5
    x, y = u, v
    for _ in range(8):  # which pixel of the first camera looks at the same place
        here = depth[np.clip(y, 0, SIZE[0] - 1).astype(int), np.clip(x, 0, SIZE[1] - 1).astype(int)]
        x, y = u + K.fx * centre[0] / here, v + K.fy * centre[1] / here
    return np.asarray(0.5 + 0.2 * np.sin(1.3 * x) * np.cos(0.9 * y) + 0.2 * np.sin(0.21 * x + 0.33 * y), np.float32)


def test_depths_of_a_step_come_back_and_threads_change_no_bit() -> None:
    depth = np.where(np.arange(SIZE[1]) < 80, 2.0, 3.0) * np.ones(SIZE)
    poses = [np.array([dx, dy, 0.0]) for dx, dy in ((0.1, 0), (-0.1, 0.02), (0.05, 0.1), (0, -0.1))]
    shots = [PosedImage(textured(c, depth), np.eye(3), c) for c in poses]
    reference = PosedImage(textured(np.zeros(3), depth), np.eye(3), np.zeros(3))
    noise = np.full(SIZE, 0.05, np.float32)
    one, two = (sweep(reference, shots, K, (1.0, 0.2), noise, threads=threads) for threads in (1, 2))
    assert (one.inverse_depth == two.inverse_depth).all()
    inner = np.zeros(SIZE, bool)
    inner[15:-15, 15:70] = inner[15:-15, 95:-15] = True
    wrong = np.abs(one.inverse_depth * depth - 1)[inner]
    assert np.median(wrong) < 0.01
    assert np.percentile(wrong, 95) < 0.05
    assert np.median(one.confidence[inner]) > 0.9


def test_the_winner_is_the_cheapest_plane_and_its_rivals_are_further_away() -> None:
    rng = np.random.default_rng(0)
    cost = rng.uniform(0.1, 1, (20, 9, 333)).astype(np.float32)
    place, margin = np.empty((9, 333), np.float32), np.empty((9, 333), np.float32)
    _dense.best_plane(cost, 3, place, margin)
    best = cost.argmin(0)
    assert (np.abs(place - best) <= 0.5).all()
    far = np.abs(np.arange(20)[:, None, None] - best) > 3
    np.testing.assert_allclose(margin, np.where(far, cost, np.inf).min(0) / cost.min(0) - 1, rtol=1e-4)
    planes = np.arange(20, dtype=np.float32)[:, None, None]
    bowl = (planes - np.float32(7.3)) ** 2 + np.zeros((1, 9, 333), np.float32)
    _dense.best_plane(bowl, 3, place, margin)
    np.testing.assert_allclose(place, 7.3, atol=1e-3)
    with pytest.raises(ValueError, match="same size"):
        _dense.best_plane(cost, 3, place[:, :-1].copy(), margin)


def test_what_a_picture_did_not_see_counts_as_unsure() -> None:
    warped = np.array([[1.0, np.nan, 9.0]], np.float32)
    total = np.ones((1, 3), np.float32)
    _dense.add_cost(warped, np.zeros((1, 3), np.float32), np.full((1, 3), 2, np.float32), 4.0, 2.5, total)
    np.testing.assert_array_equal(total, [[3, 3.5, 5]])


@pytest.mark.parametrize("size", [(400, 250), (1280, 720)])
def test_landmarks_fill_what_a_sweep_leaves_uncertain(size: tuple[int, int]) -> None:
    width, height = size
    intrinsics = Intrinsics.from_fov(width, height, 60)
    rng = np.random.default_rng(0)
    pixels = rng.uniform(0, [width / 4, height / 4], (100, 2))  # in one corner, on a plane
    local = intrinsics.unproject(pixels) * (4 + pixels[:, :1] / width)
    confidence = np.zeros((height, width), np.float32)
    confidence[:, -10:] = 1
    swept = Sweep(np.full((height, width), 0.7, np.float32), confidence)
    filled = _filled(swept, np.concatenate([local, [[0, 0, -3.0], [100, 0, 1.0]]]), intrinsics)
    depth = 1 / filled.inverse_depth
    assert depth[:, -10:] == pytest.approx(1 / 0.7, rel=1e-5)
    assert depth[20, 20] == pytest.approx(4.05, rel=0.02)
    assert np.isfinite(depth).all() and depth[:, :-10].min() > 3.9 and depth[:, :-10].max() < 4.4
    outside = np.array([[100.0, 0, 1.0]])
    assert _filled(swept, outside, intrinsics) is swept
