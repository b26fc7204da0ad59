"""Interface of a scene to the simulator: image and depth from any pose."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from spiked.sensor import Intrinsics

LUMINANCE = np.array([0.299, 0.587, 0.114], np.float32)
"""Weights of red, green and blue in the grey that a colourless sensor sees."""


@dataclass(frozen=True)
class View:
    """A noise-free picture."""

    intensity: NDArray[np.float32]
    """Upright [height, width, channels], linear, 1 is white; grey has one channel and colour three."""
    depth: NDArray[np.float32]
    """Along the optical axis at each pixel's centre [height, width], in the scene's length unit; infinite where there
    is nothing."""


class ViewableScene(Protocol):
    """A scene that can be rendered."""

    def render(
        self,
        intrinsics: Intrinsics,
        width: int,
        height: int,
        rotation: NDArray[np.float64],
        centre: NDArray[np.float64],
    ) -> View:
        """The picture of a camera at a camera-to-world pose [3, 3] and [3]."""
        ...
