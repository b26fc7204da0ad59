"""Structural dissimilarity of a rendered image, with its gradient for `Rasteriser.backward`."""

import numpy as np

from spiked.errors import ConfigurationError
from spiked.native._raster import mean_ssim
from spiked.render.splats import Floats


def dssim(rendered: Floats, *, target: Floats, white: float = 1.0) -> tuple[float, Floats]:
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
        dssim(np.ascontiguousarray(rendered[:, :, c]), target=np.ascontiguousarray(target[:, :, c]), white=white)
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
