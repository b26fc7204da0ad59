"""The fused losses against float64 torch, values and gradients."""

import numpy as np
import pytest
import torch

from spiked.errors import ConfigurationError
from spiked.render.loss import Penalty, dssim, robust


def images(*shape: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(4)
    target = rng.uniform(0, 0.6, shape).astype(np.float32)
    return (target + rng.normal(0, 0.08, shape)).astype(np.float32), target


def relative(actual: np.ndarray, expected: np.ndarray) -> float:
    return float(np.linalg.norm(actual - expected) / np.linalg.norm(expected))


@pytest.mark.parametrize("penalty", Penalty)
@pytest.mark.parametrize("shape", [(37, 53), (9, 7, 3)])
def test_robust_loss_matches_its_formula(penalty: Penalty, shape: tuple[int, ...]) -> None:
    rendered, target = images(*shape)
    weight = np.random.default_rng(5).uniform(0, 3, shape).astype(np.float32)
    scale = 0.05
    loss, gradient = robust(rendered, target, weight, scale, penalty)
    x = torch.tensor(rendered.astype(np.float64), requires_grad=True)
    r = x - torch.tensor(target.astype(np.float64))
    if penalty is Penalty.CHARBONNIER:
        cost = scale**2 * (torch.sqrt(1 + (r / scale) ** 2) - 1)
    else:
        cost = torch.where(r.abs() <= scale, r**2 / 2, scale * (r.abs() - scale / 2))
    expected = (torch.tensor(weight) * cost).sum()
    expected.backward()
    assert loss == pytest.approx(expected.item(), rel=1e-6)
    assert relative(gradient, x.grad.numpy()) < 1e-6


def test_a_weight_of_zero_leaves_a_pixel_out() -> None:
    rendered, target = images(6, 8)
    weight = np.ones((6, 8), np.float32)
    weight[2, 3] = 0
    loss, gradient = robust(rendered, target, weight, 0.1)
    rendered[2, 3] = 50
    assert robust(rendered, target, weight, 0.1)[0] == loss
    assert gradient[2, 3] == 0
    assert robust(rendered, target, 2.0, 0.1)[1][0, 0] == 2 * gradient[0, 0]


def torch_dssim(x: torch.Tensor, y: torch.Tensor, white: float) -> torch.Tensor:
    k = torch.arange(-5, 6, dtype=torch.float64)
    window = torch.exp(-(k**2) / (2 * 1.5**2))
    window = window / window.sum()
    kernel = (window[:, None] * window[None, :])[None, None]

    def blur(image: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.conv2d(image[None, None], kernel, padding=5)[0, 0]

    m, n = blur(x), blur(y)
    xx, yy, xy = blur(x * x) - m * m, blur(y * y) - n * n, blur(x * y) - m * n
    c1, c2 = (0.01 * white) ** 2, (0.03 * white) ** 2
    return 1 - ((2 * m * n + c1) * (2 * xy + c2) / ((m * m + n * n + c1) * (xx + yy + c2))).mean()


@pytest.mark.parametrize(("height", "width"), [(37, 53), (4, 3), (64, 16)])
@pytest.mark.parametrize("white", [1.0, 0.4])
def test_dssim_matches_torch(height: int, width: int, white: float) -> None:
    rendered, target = images(height, width)
    loss, gradient = dssim(rendered, target, white)
    x = torch.tensor(rendered.astype(np.float64), requires_grad=True)
    expected = torch_dssim(x, torch.tensor(target.astype(np.float64)), white)
    expected.backward()
    assert loss == pytest.approx(expected.item(), abs=1e-5)
    assert relative(gradient, x.grad.numpy()) < 1e-4


def test_dssim_of_colours_is_their_mean() -> None:
    rendered, target = images(20, 24, 3)
    loss, gradient = dssim(rendered, target)
    parts = [dssim(rendered[:, :, c], target[:, :, c]) for c in range(3)]
    assert loss == pytest.approx(np.mean([part[0] for part in parts]))
    np.testing.assert_allclose(gradient[:, :, 1], parts[1][1] / 3, rtol=1e-6)


def test_an_image_is_like_itself() -> None:
    _, target = images(40, 30)
    loss, gradient = dssim(target, target)
    assert abs(loss) < 1e-6
    assert np.abs(gradient).max() < 1e-6


def test_mistakes_are_told() -> None:
    rendered, target = images(20, 24)
    with pytest.raises(ConfigurationError, match="no loss against"):
        robust(rendered, target[:5], 1, 0.1)
    with pytest.raises(ConfigurationError, match="do not fit"):
        robust(rendered, target, np.ones(7), 0.1)
    with pytest.raises(ConfigurationError, match="positive"):
        robust(rendered, target, 1, 0)
    with pytest.raises(ConfigurationError, match="structural similarity"):
        dssim(rendered[0], target[0])
