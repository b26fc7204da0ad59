"""Losses of a rendered image with their gradients, ready for `Rasteriser.backward`."""

from enum import Enum

import numpy as np
from numpy.typing import ArrayLike

from spiked.errors import ConfigurationError
from spiked.native._raster import mean_ssim, robust_loss
from spiked.render.splats import Floats


class Penalty(Enum):
    """What a residual r costs at scale s; both are r^2 / 2 for small r and s |r| for large r, up to a constant."""

    CHARBONNIER = "charbonnier"
    """s^2 (sqrt(1 + (r / s)^2) - 1)"""
    HUBER = "huber"
    """r^2 / 2 up to |r| = s, then s (|r| - s / 2)"""


def robust(
    rendered: Floats, target: Floats, weight: ArrayLike, scale: float, penalty: Penalty = Penalty.CHARBONNIER
) -> tuple[float, Floats]:
    """sum of weight * penalty(rendered - target), and its gradient by rendered.

    rendered and target have any, but the same, shape; weight broadcasts to it (an inverse variance, or a mean's 1 / N;
    0 leaves a pixel out). scale is in the unit of the values. Raises ConfigurationError for other shapes and scales.
    """
    rendered, target = _pair(rendered, target)
    if not scale > 0:
        raise ConfigurationError(f"the scale of a robust loss is {scale:g}: it must be positive")
    weights = np.asarray(weight, np.float32)
    if weights.shape != rendered.shape:
        try:
            weights = np.broadcast_to(weights, rendered.shape)
        except ValueError as error:
            raise ConfigurationError(f"weights {weights.shape} do not fit an image {rendered.shape}") from error
    gradient = np.empty_like(rendered)
    weights = np.ascontiguousarray(weights)
    return robust_loss(rendered, target, weights, penalty is Penalty.HUBER, scale, gradient), gradient


def dssim(rendered: Floats, target: Floats, white: float = 1.0) -> tuple[float, Floats]:
    """1 - mean SSIM over the pixels (and colours), and its gradient by rendered.

    Images are [H, W] or [H, W, C]; white is the value that counts as full scale, C1 = (0.01 white)^2 and
    C2 = (0.03 white)^2. The window is a Gaussian of 11x11 pixels with sigma 1.5; outside the image both are zero.
    (Z. Wang et al., "Image quality assessment: from error visibility to structural similarity", 2004; padding as in 3D
    Gaussian splatting.) Raises ConfigurationError for other shapes.
    """
    rendered, target = _pair(rendered, target)
    if rendered.ndim not in (2, 3) or rendered.size == 0:
        raise ConfigurationError(f"structural similarity is of images [H, W] or [H, W, C], not {rendered.shape}")
    if not white > 0:
        raise ConfigurationError(f"white is {white:g}: it must be positive")
    if rendered.ndim == 2:
        gradient = np.empty_like(rendered)
        similarity = mean_ssim(rendered, target, white, gradient)
        return 1 - similarity, np.negative(gradient, out=gradient)
    colours = rendered.shape[2]
    parts = [
        dssim(np.ascontiguousarray(rendered[:, :, c]), np.ascontiguousarray(target[:, :, c]), white)
        for c in range(colours)
    ]
    gradients = np.stack([gradient for _, gradient in parts], axis=2) / np.float32(colours)
    return sum(loss for loss, _ in parts) / colours, gradients


def _pair(rendered: Floats, target: Floats) -> tuple[Floats, Floats]:
    rendered = np.ascontiguousarray(rendered, np.float32)
    target = np.ascontiguousarray(target, np.float32)
    if rendered.shape != target.shape:
        raise ConfigurationError(f"a rendered image {rendered.shape} has no loss against a target {target.shape}")
    return rendered, target
