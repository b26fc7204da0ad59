"""Rendering of Gaussian splats: `rasteriser_for` gives the best rasteriser here, of `cpu.Rasteriser` and
`cuda.CudaRasteriser`; `reference.render` (torch, float64) is there to check them against.
"""

from spiked.render.camera import Camera
from spiked.render.choice import AnyRasteriser, rasteriser_for
from spiked.render.cpu import Rasteriser
from spiked.render.splats import Gradients, Image, SplatArrays, Splats

__all__ = ["AnyRasteriser", "Camera", "Gradients", "Image", "Rasteriser", "SplatArrays", "Splats", "rasteriser_for"]
