"""A scene seen through a lens with distortion: a wide picture without it, in fine pixels, resampled."""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from spiked.sensor import Image, Intrinsics
from spiked.simulate.splats import SplatScene
from spiked.simulate.view import View, ViewableScene
from spiked.undistortion import straight_camera

FINENESS = 2
"""Pixels of the wide picture for one of the sensor, along each side, in the middle of the image."""
SAMPLES = 4
"""Samples of a sensor's pixel along each side: at the edge of a fisheye image it covers many pixels of the wide one."""
BOX_PX2 = 1 / 12
"""Variance along each side of the mean over a pixel, in pixels squared."""
BILINEAR_PX2 = 1 / 6
"""Mean variance of bilinear interpolation between pixels, in pixels squared."""
LARGEST_SIDE = 4096
"""Largest side of the wide picture in pixels: the rasteriser's."""


@dataclass(frozen=True)
class Lens:
    """How a camera with distortion resamples a wide picture without it."""

    intrinsics: Intrinsics
    width: int
    height: int

    @cached_property
    def wide(self) -> tuple[Intrinsics, int, int]:
        """The wide camera and its width and height: it sees all that the sensor sees. Raises ConfigurationError."""
        return straight_camera(self.intrinsics, self.width, self.height, FINENESS, LARGEST_SIDE)

    @cached_property
    def _places(self) -> list[NDArray[np.float32]]:
        """Where the samples of the sensor's pixels lie in the wide picture, [H, W, 2] each; OpenCV's coordinates."""
        y, x = np.mgrid[0 : self.height, 0 : self.width].astype(np.float64)
        # The wide picture is filtered, too. Where the lens shrinks it, less of that is left.
        centres = np.stack([x + 0.5, y + 0.5], -1)
        shrunk = self.wide[0].fx / np.asarray(self.intrinsics.focal_at(centres))
        missing = np.maximum(BOX_PX2 - (BOX_PX2 + BILINEAR_PX2) / shrunk**2, 0)
        spacing = np.sqrt(12 * missing / (SAMPLES**2 - 1))
        parts = np.arange(SAMPLES) - (SAMPLES - 1) / 2
        found = []
        for down in parts:
            for across in parts:
                rays = self.intrinsics.unproject(centres + np.stack([across * spacing, down * spacing], -1))
                found.append((self.wide[0].project(rays) - 0.5).astype(np.float32))
        return found

    def view(self, wide: View) -> View:
        """The sensor's picture from the wide one; its depth is the mean depth of a pixel's nearest samples."""
        total: Image | None = None
        for places in self._places:
            part = cv2.remap(wide.intensity, places, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            total = part.astype(np.float32) if total is None else total + part
        assert total is not None
        depth = cv2.remap(wide.depth, sum(self._places) / np.float32(len(self._places)), None, cv2.INTER_NEAREST)
        intensity = (total / np.float32(len(self._places))).reshape(self.height, self.width, -1)
        return View(np.ascontiguousarray(intensity), np.asarray(depth, np.float32))


class LensedScene:
    """A scene as cameras with and without distortion see it.

    Gaussians are drawn through the lens itself: the blur that the rasteriser adds, in its own pixels, makes those of a
    wide picture in fine pixels thinner, and another scene.
    """

    def __init__(self, scene: ViewableScene) -> None:
        self._scene = scene
        self._lens: Lens | None = None

    def render(
        self,
        intrinsics: Intrinsics,
        width: int,
        height: int,
        rotation: NDArray[np.float64],
        centre: NDArray[np.float64],
    ) -> View:
        """See `ViewableScene.render`."""
        if intrinsics.distortion is None or isinstance(self._scene, SplatScene):
            return self._scene.render(intrinsics, width, height, rotation, centre)
        lens = Lens(intrinsics, width, height)
        if self._lens != lens:
            self._lens = lens
        return self._lens.view(self._scene.render(*self._lens.wide, rotation, centre))
