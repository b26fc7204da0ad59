"""The arrays that go into a renderer and come out of it."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]


class SplatArrays(Protocol):
    """Anything with the five parameter arrays of N Gaussians, such as `Splats`."""

    @property
    def means(self) -> Floats: ...
    @property
    def quats(self) -> Floats: ...
    @property
    def log_scales(self) -> Floats: ...
    @property
    def opacity_logits(self) -> Floats: ...
    @property
    def colours(self) -> Floats: ...


@dataclass
class Splats:
    """N Gaussians. Arrays are float32 and C-contiguous."""

    means: Floats
    """World positions, [N, 3]."""
    quats: Floats
    """Rotations, wxyz, of any length but zero (a zero quaternion counts as no rotation), [N, 4]."""
    log_scales: Floats
    """Natural logarithms of the standard deviations along the splat's axes, [N, 3]."""
    opacity_logits: Floats
    """Opacity is 1 / (1 + exp(-logit)), [N]."""
    colours: Floats
    """Radiance in expected spikes a frame, not clamped, [N, C] with C = 1 or 3."""


@dataclass(frozen=True)
class Image:
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
    """Gradients of sum(d_values * values), and what a mapper wants to know of each splat. Shapes as in `Splats`."""

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
