"""Adam over the arrays of a scene, for the splats that were seen only.

(D. Kingma, J. Ba, "Adam: a method for stochastic optimization", 2015.)
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]


class Adam:
    """First and second moments of arrays whose first axis counts splats, and the number of steps each splat took."""

    def __init__(self, arrays: Sequence[Array], beta1: float = 0.9, beta2: float = 0.999) -> None:
        self.beta1, self.beta2 = np.float32(beta1), np.float32(beta2)
        self._moments = [(np.zeros_like(a), np.zeros_like(a)) for a in arrays]
        self._taken = np.zeros(len(arrays[0]), np.float32)

    def grow(self, count: int) -> None:
        """Make room for `count` new splats at the end."""
        self._moments = [(_grown(first, count), _grown(second, count)) for first, second in self._moments]
        self._taken = _grown(self._taken, count)

    def keep(self, rows: NDArray[np.bool_]) -> None:
        """Forget all splats but `rows`."""
        self._moments = [(first[rows], second[rows]) for first, second in self._moments]
        self._taken = self._taken[rows]

    def step(
        self, arrays: Sequence[Array], gradients: Sequence[Array], rates: Sequence[float], seen: NDArray[np.bool_]
    ) -> None:
        """Change `arrays` in place; `rates` has a learning rate for each of them."""
        self._taken += seen
        tiny = np.float32(1e-15)
        taken = np.maximum(self._taken, 1)
        correction = np.sqrt(1 - self.beta2**taken) / (1 - self.beta1**taken) * seen
        for array, gradient, rate, (first, second) in zip(arrays, gradients, rates, self._moments, strict=True):
            shape = (-1,) + (1,) * (array.ndim - 1)
            first *= self.beta1
            first += (1 - self.beta1) * gradient
            second *= self.beta2
            second += (1 - self.beta2) * gradient * gradient
            array -= np.float32(rate) * correction.reshape(shape) * first / (np.sqrt(second) + tiny)


def _grown(array: Array, count: int) -> Array:
    return np.concatenate([array, np.zeros((count, *array.shape[1:]), array.dtype)])
