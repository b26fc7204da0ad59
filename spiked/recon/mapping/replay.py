"""Renders of maps as targets: a map is trained on them where the recording that it was made from is not at hand."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from spiked.pose import Array
from spiked.recon.frontend.windowing import SITE_SHARES, grey
from spiked.recon.mapping.pyramid import Target
from spiked.render import AnyRasteriser, RenderedImage
from spiked.render.splats import AnySplats
from spiked.scene import Scene
from spiked.sensor import Image

LEAST_OPACITY = 0.9
"""Opacity of the pixels that are compared: what a map never saw is no target."""


@dataclass(frozen=True)
class Replay:
    """What a map shows from one pose, camera to world."""

    rasteriser: AnyRasteriser
    """Of the camera of that map."""
    rotation: Array
    centre: Array
    values: Image
    """[H, W] of a grey map or [H, W, 3], radiance."""
    depth: Image
    opacity: Image
    """[H, W]"""

    @classmethod
    def of(cls, rasteriser: AnyRasteriser, scene: Scene, rotation: Array, centre: Array) -> "Replay":
        """Render a scene."""
        image = rasteriser.forward(scene, rotation[None], centre[None])
        return cls(rasteriser, rotation, centre, image.values, image.depth, image.alpha)

    def only(self, pixels: NDArray[np.bool_]) -> "Replay":
        """The same without the other pixels [H, W]."""
        return replace(self, opacity=np.where(pixels, self.opacity, np.float32(0)))

    def brightened(self, brightness: float) -> "Replay":
        """The same with its radiance multiplied by `brightness`."""
        return replace(self, values=self.values * np.float32(brightness))

    @cached_property
    def known(self) -> Image:
        """[H, W], 1 where the map has surfaces, else 0."""
        return (self.opacity > LEAST_OPACITY).astype(np.float32)

    def render(self, scene: AnySplats, background: float = 0.0) -> RenderedImage:
        """Another scene from the same pose."""
        return self.rasteriser.forward(scene, self.rotation[None], self.centre[None], background=background)

    def comparable(self, image: Image) -> Image:
        """An image [H, W] or [H, W, 3] without the colours that this map does not know."""
        return grey(image) if self.values.ndim == 2 else image

    def slope(self, slope: Image, image: Image) -> Image:
        """The gradient by an image, from that by what is `comparable` of it."""
        return slope if slope.ndim == image.ndim else np.ascontiguousarray(slope[..., None] * SITE_SHARES)

    def target(self, shown: Image) -> Target:
        """The target for what is comparable of an image, which is right where this map has no surface."""
        known = self.known if shown.ndim == 2 else self.known[..., None]
        values = np.where(known > 0, self.values, shown)
        return Target(values, np.zeros_like(values), None)

    def error(self, scene: Scene, white: float) -> float:
        """Mean squared error of another scene where this map has surfaces, in units of white squared."""
        apart = (self.comparable(self.render(scene).values) - self.values) / white
        known = self.known > 0
        return float(np.mean(apart[known] ** 2)) if known.any() else 0.0
