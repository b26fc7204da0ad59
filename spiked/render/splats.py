"""What comes out of a renderer: images and gradients. What goes in is a `spiked.scene.Scene`."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spiked.scene import Scene

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class DeviceScene:
    """Splats on a GPU, with their moments of Adam: what its rasteriser takes in the place of a Scene."""

    native: Any

    def __len__(self) -> int:
        return int(self.native.count)


AnySplats = Scene | DeviceScene
"""What rasterisers render."""


@dataclass(frozen=True)
class SizeLimits:
    """How large splats may become in a step of gradient descent."""

    log_scale: float = np.inf
    """Largest logarithm of a standard deviation."""
    widest: float = np.inf
    """Largest standard deviation over the distance from `centre`: as seen from there, radians."""
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Of a camera."""

    def most(self, means: Floats) -> Floats:
        """Largest logarithms of the standard deviations of splats at means [N, 3]; [N, 1], or [] for all."""
        most = np.float32(self.log_scale)
        if not np.isfinite(self.widest):
            return np.asarray(most)
        offset = means - np.array(self.centre, np.float32)
        square = np.maximum(np.einsum("nd,nd->n", offset, offset), np.finfo(np.float32).tiny)
        seen: Floats = 0.5 * np.log(square) + np.float32(np.log(self.widest))
        return np.minimum(most, seen)[:, None]


@dataclass(frozen=True)
class MeanAxes:
    """Along what means move in a step of gradient descent; their learning rate is in units of these axes (decision
    65)."""

    blur: float = 1.0
    """A length, in the scene's unit."""
    own: bool = False
    """Whether they are the axes of each splat, as long as its standard deviations blurred by `blur`: the root of the
    sum of their squares. Otherwise those of the world, as long as that."""


@dataclass(frozen=True)
class RenderedImage:
    """A rendered image of H rows and W columns; with sub-poses, sums or means over them."""

    values: Floats
    """sum_s weights_s C_s, radiance; [H, W] for one colour or a mosaic, else [H, W, 3]."""
    alpha: Floats
    """Opacity, sum_s weights_s A_s / sum_s weights_s; 0 where the weights are 0. [H, W]"""
    depth: Floats
    """Expected z over what is opaque: sum of alpha T z over sum of alpha T, both weighted over the sub-poses; 0 where
    nothing is. [H, W]"""


@dataclass(frozen=True)
class Gradients:
    """Gradients of sum(d_values * values), and the visibility of each splat. Shapes as in `Scene`."""

    means: Floats
    quats: Floats
    log_scales: Floats
    opacity_logits: Floats
    colours: Floats
    rotation: NDArray[np.float64]
    """With respect to phi in R <- Exp(phi) R, R camera to world; [S, 3]."""
    centre: NDArray[np.float64]
    """With respect to the camera centres; [S, 3]."""
    contribution: Floats
    """Sum over the pixels of alpha T, in pixels, mean over the sub-poses; [N]."""
    radius_px: Floats
    """Largest half axis of the projected ellipse where alpha falls to 1/255, over the sub-poses; 0 for a splat that no
    sub-pose sees. [N]"""

    def arrays(self) -> tuple[Floats, Floats, Floats, Floats, Floats]:
        """The gradients by the five arrays of `Scene.arrays`, in their order."""
        return self.means, self.quats, self.log_scales, self.opacity_logits, self.colours
