"""Rendering of Gaussian splats: `rasteriser_for` gives the best rasteriser here, of `cpu.Rasteriser` and
`gpu.GpuRasteriser`; `reference.render` (torch, float64) is there to check them against.
"""

from spiked.render.camera import Camera
from spiked.render.choice import AnyRasteriser, rasteriser_for
from spiked.render.cpu import Rasteriser
from spiked.render.splats import Gradients, RenderedImage
from spiked.scene import Scene

# Names of earlier releases, deprecated: use `spiked.scene.Scene`. They go with the next release.
Splats = SplatArrays = Scene

__all__ = [
    "AnyRasteriser",
    "Camera",
    "Gradients",
    "Rasteriser",
    "RenderedImage",
    "SplatArrays",
    "Splats",
    "rasteriser_for",
]
