"""Structural dissimilarity of a rendered image, with its gradient for `Rasteriser.backward`."""

import numpy as np

from spiked.errors import ConfigurationError
from spiked.native._raster import Similarity
from spiked.render.cpu import usable_cores
from spiked.render.splats import Floats


class StructuralSimilarity:
    """1 - mean SSIM over the pixels (and colours), and its gradient. One object serves one thread at a time; the number
    of threads it works with changes no bit."""

    def __init__(self, threads: int | None = None) -> None:
        """Threads default to the cores this process may use."""
        self._threads = usable_cores() if threads is None else threads
        self._native = Similarity(self._threads)

    def __getstate__(self) -> dict[str, object]:
        return {"_threads": self._threads}

    def __setstate__(self, state: dict[str, object]) -> None:
        vars(self).update(state)
        self._native = Similarity(self._threads)

    def __call__(self, rendered: Floats, target: Floats, white: float = 1.0) -> tuple[float, Floats]:
        """The value and its gradient by rendered.

        Images are [H, W] or [H, W, C]; white is the value that counts as full scale, C1 = (0.01 white)^2 and
        C2 = (0.03 white)^2. The window is a Gaussian of 11x11 pixels with sigma 1.5; outside the image both are zero.
        (Z. Wang et al., "Image quality assessment: from error visibility to structural similarity", 2004; padding as in
        3D Gaussian splatting.) Raises ConfigurationError for other shapes.
        """
        rendered, target = _pair(rendered, target)
        if rendered.ndim not in (2, 3) or rendered.size == 0:
            raise ConfigurationError(f"structural similarity is of images [H, W] or [H, W, C], not {rendered.shape}")
        if not white > 0:
            raise ConfigurationError(f"white is {white:g}: it must be positive")
        if rendered.ndim == 2:
            gradient = np.empty_like(rendered)
            similarity = self._native.mean(rendered, target, white, gradient)
            return 1 - similarity, np.negative(gradient, out=gradient)
        colours = rendered.shape[2]
        parts = [
            self(np.ascontiguousarray(rendered[:, :, c]), np.ascontiguousarray(target[:, :, c]), white)
            for c in range(colours)
        ]
        gradients = np.stack([gradient for _, gradient in parts], axis=2) / np.float32(colours)
        return sum(loss for loss, _ in parts) / colours, gradients


def dssim(rendered: Floats, *, target: Floats, white: float = 1.0) -> tuple[float, Floats]:
    """`StructuralSimilarity` of two images, on one thread."""
    return StructuralSimilarity(1)(rendered, target, white)


def _pair(rendered: Floats, target: Floats) -> tuple[Floats, Floats]:
    rendered = np.ascontiguousarray(rendered, np.float32)
    target = np.ascontiguousarray(target, np.float32)
    if rendered.shape != target.shape:
        raise ConfigurationError(f"a rendered image {rendered.shape} has no loss against a target {target.shape}")
    return rendered, target
