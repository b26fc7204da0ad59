"""Colours of a raw mosaic image."""

import cv2
import numpy as np
from numpy.typing import NDArray

from spiked.sensor import Image


def fill_mosaic(rate: Image, channels: NDArray[np.uint8] | None) -> Image:
    """Colours [H, W, C] of an observed image [H, W], for display and initial colours; C is 1 without `channels`.

    Each colour is the normalised average of its own sites nearby; grey passes through.
    """
    if channels is None:
        return rate[..., None]
    planes = []
    for c in range(3):
        here = (channels == c).astype(np.float32)
        planes.append(cv2.GaussianBlur(rate * here, (5, 5), 0) / np.maximum(cv2.GaussianBlur(here, (5, 5), 0), 1e-6))
    return np.stack(planes, -1)
