"""Image features that are found again from other distances and in other light, and their matches."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from spiked.pose import Array
from spiked.recon.frontend.feature_tracks import Picture

CONTRAST = 0.015
"""Least contrast of a feature (OpenCV's `contrastThreshold`). With its default 0.04 the poorest of 30 views of a
walk has 287 features instead of 500."""
RATIO = 0.85
"""Largest distance of a match over that of the next best one. On a walk 252 of 264 matches with the best reference
agree with one pose (medians of 30 views); with 0.75 it is 246 of 250, with 0.95 260 of 284."""


@dataclass(frozen=True)
class Features:
    """Distinctive places of an image with descriptors that do not depend on scale, brightness and contrast."""

    pixels: Array
    """[n, 2] px, pixel centres at +0.5."""
    descriptors: NDArray[np.float32]
    """[n, 128] of unit length: square roots of gradient histograms (SIFT, Lowe 2004; RootSIFT, Arandjelovic 2012)."""

    def __len__(self) -> int:
        return len(self.pixels)

    def select(self, rows: NDArray[np.bool_]) -> "Features":
        """Those where `rows` [n] is true."""
        return Features(self.pixels[rows], self.descriptors[rows])


def find_features(image: Picture, count: int) -> Features:
    """The `count` strongest features of an image [H, W], or fewer."""
    points, found = cv2.SIFT.create(nfeatures=count, contrastThreshold=CONTRAST).detectAndCompute(image, None)
    if not points:
        return Features(np.zeros((0, 2)), np.zeros((0, 128), np.float32))
    pixels = np.array([point.pt for point in points], np.float64) + 0.5
    histograms = found / np.maximum(found.sum(1, keepdims=True), 1e-9)
    return Features(pixels, np.sqrt(histograms).astype(np.float32))


def match(a: Features, b: Features) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows of `a` and of `b` [m] that are each other's nearest, and clearly nearer than the next."""
    if len(a) == 0 or len(b) < 2:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    likeness = a.descriptors @ b.descriptors.T
    best = likeness.argmax(1)
    rows = np.arange(len(a))
    top = likeness[rows, best]
    likeness[rows, best] = -1.0
    second = likeness.max(1)
    likeness[rows, best] = top
    # Of unit vectors: squared distance = 2 - 2 likeness.
    keep = ((1 - top) < RATIO**2 * (1 - second)) & (likeness.argmax(0)[best] == rows)
    return rows[keep], best[keep]
