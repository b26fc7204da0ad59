"""Rendering of Gaussian splats: `cpu.Rasteriser` for work, `reference.render` (torch, float64) to check it against."""

from spiked.render.camera import Camera
from spiked.render.cpu import Rasteriser
from spiked.render.splats import Gradients, Image, SplatArrays, Splats

__all__ = ["Camera", "Gradients", "Image", "Rasteriser", "SplatArrays", "Splats"]
