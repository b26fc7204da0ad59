"""Adam over the arrays of a scene, for visible splats only.

D. Kingma, J. Ba, "Adam: a method for stochastic optimization", 2015.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from spiked.errors import ConfigurationError
from spiked.native._raster import AdamSteps, adam_corrections
from spiked.render.cpu import usable_cores
from spiked.render.splats import Floats, MeanAxes
from spiked.scene import Scene


class Adam:
    """First and second moments of arrays whose first axis counts splats.

    Every splat has its own number of steps: one that is not seen keeps its parameters, moments and number, so that a
    splat's first step has the full learning rate whenever it comes. Moments of a splat are those of its own last steps.
    """

    def __init__(
        self,
        arrays: Sequence[Floats],
        beta1: float = 0.9,
        beta2: float = 0.999,
        epsilon: float = 1e-15,
        threads: int | None = None,
    ) -> None:
        """arrays: float32 [N] or [N, K], K at most 4, as they will be given to step(). Threads default to the cores
        this process may use; their number changes no bit."""
        self._threads = usable_cores() if threads is None else threads
        self._steps = AdamSteps(self._threads)
        self._betas = (beta1, beta2)
        self.epsilon = epsilon
        """What is added to the root of the second moments."""
        self._moments = [(np.zeros_like(array), np.zeros_like(array)) for array in arrays]
        self._taken = np.zeros(len(arrays[0]), np.uint32)

    def __getstate__(self) -> dict[str, object]:
        return {name: value for name, value in vars(self).items() if name != "_steps"}

    def __setstate__(self, state: dict[str, object]) -> None:
        vars(self).update(state)
        self._steps = AdamSteps(self._threads)

    @property
    def taken(self) -> NDArray[np.uint32]:
        """The number of steps that each splat has made, [N]."""
        return self._taken

    def packed(self) -> tuple[Floats, Floats, NDArray[np.uint32]]:
        """First and second moments, each [N, columns of all arrays], and `taken`: as a device keeps them."""
        first, second = (np.concatenate([_rows(pair[i]) for pair in self._moments], axis=1) for i in (0, 1))
        return first, second, self._taken.copy()

    def unpack(self, first: Floats, second: Floats, taken: NDArray[np.uint32]) -> None:
        """Take over what `packed` gives."""
        at = 0
        for pair in self._moments:
            columns = _rows(pair[0]).shape[1]
            for mine, theirs in zip(pair, (first, second), strict=True):
                _rows(mine)[:] = theirs[:, at : at + columns]
            at += columns
        self._taken = taken

    def grow(self, count: int) -> None:
        """Make room for `count` new splats at the end."""
        self._moments = [(_grown(first, count), _grown(second, count)) for first, second in self._moments]
        self._taken = np.concatenate([self._taken, np.zeros(count, np.uint32)])

    def keep(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> None:
        """Forget all splats but `rows`."""
        self._moments = [(first[rows], second[rows]) for first, second in self._moments]
        self._taken = self._taken[rows]

    def reset(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> None:
        """Reset the moments of splats, for instance after they were relocated."""
        for first, second in self._moments:
            first[rows] = 0
            second[rows] = 0
        self._taken[rows] = 0

    def step(
        self,
        arrays: Sequence[Floats],
        gradients: Sequence[Floats],
        rates: Sequence[float],
        seen: NDArray[np.bool_] | None = None,
    ) -> None:
        """Change the float32, C-contiguous arrays in place.

        rates has a learning rate for each array; seen [N] says which splats to change, all by default. Raises
        ConfigurationError when shapes differ from those of the moments.
        """
        if not len(arrays) == len(gradients) == len(rates) == len(self._moments):
            raise ConfigurationError(f"Adam was made for {len(self._moments)} arrays; give it that many of each")
        count = len(self._taken)
        seen = np.ones(count, np.bool_) if seen is None else seen
        for array, gradient, (first, _) in zip(arrays, gradients, self._moments, strict=True):
            if array.shape != first.shape or gradient.shape != first.shape or seen.shape != (count,):
                raise ConfigurationError(
                    f"Adam holds moments {first.shape} for an array {array.shape} with gradient {gradient.shape} and "
                    f"seen {seen.shape}: call grow() and keep() along with the scene"
                )
            if array.dtype != np.float32 or not array.flags.c_contiguous:
                raise ConfigurationError("Adam changes arrays in place: they must be float32 and C-contiguous")
        correction = np.empty(count, np.float32)
        adam_corrections(np.ascontiguousarray(seen).view(np.uint8), self._taken, correction, *self._betas)
        for array, gradient, rate, (first, second) in zip(arrays, gradients, rates, self._moments, strict=True):
            self._steps.step(
                _rows(array),
                _rows(np.ascontiguousarray(gradient, np.float32)),
                _rows(first),
                _rows(second),
                correction,
                rate,
                *self._betas,
                self.epsilon,
            )

    def slopes_along_axes(self, scene: Scene, axes: MeanAxes, by_means: Floats) -> Floats:
        """Gradients by steps of a scene's means along the axes, from those by the means, [N, 3]."""
        by_axes = np.empty_like(by_means)
        self._steps.slopes_along_axes(scene.quats, scene.log_scales, axes.blur, axes.own, by_means, by_axes)
        return by_axes

    def move_along_axes(self, scene: Scene, axes: MeanAxes, steps: Floats) -> None:
        """Change a scene's means by such steps, [N, 3]."""
        self._steps.move_along_axes(scene.quats, scene.log_scales, axes.blur, axes.own, steps, scene.means)


def _rows(array: Floats) -> Floats:
    return array.reshape(-1, 1) if array.ndim == 1 else array


def _grown(array: Floats, count: int) -> Floats:
    return np.concatenate([array, np.zeros((count, *array.shape[1:]), array.dtype)])
