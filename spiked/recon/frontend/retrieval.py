"""Retrieval: which of many images share features with a query, by short descriptors."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from spiked.pose import Array
from spiked.recon.frontend.features import Features

REDUCED = 32
"""Length of the descriptors that images are retrieved by: principal components of those of all images."""
USUAL_RANK = 10
"""A feature speaks for the images in which it is more alike than in the tenth best one."""


class Retrieval:
    """Images that can be retrieved by the features that they share with a query."""

    def __init__(self, images: Sequence[Features]) -> None:
        """At least one of the images has features."""
        pool = np.concatenate([one.descriptors for one in images])
        self._mean = pool.mean(0)
        _, axes = np.linalg.eigh(np.cov((pool - self._mean).T))
        self._axes = np.ascontiguousarray(axes[:, -REDUCED:], np.float32)
        self._pool = self._short(pool)
        self._sizes = [len(one) for one in images]

    def __len__(self) -> int:
        return len(self._sizes)

    def add(self, image: Features) -> None:
        """Add an image; the principal components stay those of the first ones."""
        self._pool = np.concatenate([self._pool, self._short(image.descriptors)])
        self._sizes.append(len(image))

    def votes(self, query: Features) -> Array:
        """How much the features of a query speak for each image, [images]."""
        likeness = self._short(query.descriptors) @ self._pool.T
        starts = np.r_[0, np.cumsum(self._sizes)[:-1]]
        best = np.maximum.reduceat(likeness, starts, axis=1)
        rank = min(USUAL_RANK, best.shape[1])
        usual = np.partition(best, -rank, axis=1)[:, -rank, None]
        return np.asarray(np.maximum(best - usual, 0).sum(0), np.float64)

    def _short(self, descriptors: NDArray[np.float32]) -> NDArray[np.float32]:
        short = (descriptors - self._mean) @ self._axes
        return np.asarray(short / np.maximum(np.linalg.norm(short, axis=1, keepdims=True), 1e-9), np.float32)
