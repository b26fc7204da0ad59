"""Structural dissimilarity against float64 torch, value and gradient."""

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity

from spiked.errors import ConfigurationError
from spiked.render.loss import dssim


def images(*shape: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(4)
    target = rng.uniform(0, 0.6, shape).astype(np.float32)
    return (target + rng.normal(0, 0.08, shape)).astype(np.float32), target


def relative(actual: np.ndarray, expected: np.ndarray) -> float:
    return float(np.linalg.norm(actual - expected) / np.linalg.norm(expected))


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
    loss, gradient = dssim(rendered, target=target, white=white)
    x = torch.tensor(rendered.astype(np.float64), requires_grad=True)
    expected = torch_dssim(x, torch.tensor(target.astype(np.float64)), white)
    expected.backward()
    assert loss == pytest.approx(expected.item(), abs=1e-5)
    assert relative(gradient, x.grad.numpy()) < 1e-4


def test_dssim_is_that_of_scikit_image() -> None:
    """Outside of the image both are zero: a margin of zeros says so to scikit-image."""
    rendered, target = images(37, 53)
    loss, _ = dssim(rendered, target=target, white=0.8)
    _, similarity = structural_similarity(
        *(np.pad(one.astype(np.float64), 10) for one in (rendered, target)),
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=0.8,
        full=True,
    )
    assert loss == pytest.approx(1 - similarity[10:-10, 10:-10].mean(), abs=1e-6)


def test_dssim_of_colours_is_their_mean() -> None:
    rendered, target = images(20, 24, 3)
    loss, gradient = dssim(rendered, target=target)
    parts = [dssim(rendered[:, :, c], target=target[:, :, c]) for c in range(3)]
    assert loss == pytest.approx(np.mean([part[0] for part in parts]))
    np.testing.assert_allclose(gradient[:, :, 1], parts[1][1] / 3, rtol=1e-6)


def test_an_image_is_like_itself() -> None:
    _, target = images(40, 30)
    loss, gradient = dssim(target, target=target)
    assert abs(loss) < 1e-6
    assert np.abs(gradient).max() < 1e-6


def test_mistakes_are_told() -> None:
    rendered, target = images(20, 24)
    with pytest.raises(ConfigurationError, match="no loss against"):
        dssim(rendered, target=target[:5])
    with pytest.raises(ConfigurationError, match="positive"):
        dssim(rendered, target=target, white=0)
    with pytest.raises(ConfigurationError, match="structural similarity"):
        dssim(rendered[0], target=target[0])
