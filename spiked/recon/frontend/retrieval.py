"""Retrieval: which of many images share features with a query, by short descriptors."""

from collections.abc import Iterator, Sequence
from typing import Any

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
        self._images = [self._short(one.descriptors) for one in images]
        self._pool: NDArray[np.float32] | None = None
        """Those of all images, made when it is needed."""

    def __len__(self) -> int:
        return len(self._images)

    def __getstate__(self) -> dict[str, object]:
        return vars(self) | {"_pool": None}

    def fixed_arrays(self) -> Iterator[NDArray[Any]]:
        """Arrays that never change."""
        yield from self._images

    def add(self, image: Features) -> None:
        """Add an image; the principal components stay those of the first ones."""
        self._images.append(self._short(image.descriptors))
        self._pool = None

    def votes(self, query: Features) -> Array:
        """How much the features of a query speak for each image, [images]."""
        if self._pool is None:
            self._pool = np.concatenate(self._images)
        likeness = self._short(query.descriptors) @ self._pool.T
        starts = np.r_[0, np.cumsum([len(one) for one in self._images])[:-1]]
        best = np.maximum.reduceat(likeness, starts, axis=1)
        rank = min(USUAL_RANK, best.shape[1])
        usual = np.partition(best, -rank, axis=1)[:, -rank, None]
        return np.asarray(np.maximum(best - usual, 0).sum(0), np.float64)

    def _short(self, descriptors: NDArray[np.float32]) -> NDArray[np.float32]:
        short = (descriptors - self._mean) @ self._axes
        return np.asarray(short / np.maximum(np.linalg.norm(short, axis=1, keepdims=True), 1e-9), np.float32)
