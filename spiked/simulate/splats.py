"""A scene of Gaussians for the simulated camera."""

import numpy as np
from numpy.typing import NDArray

from spiked.render.camera import Camera
from spiked.render.choice import AnyRasteriser, rasteriser_for
from spiked.scene import Scene
from spiked.sensor import Intrinsics
from spiked.simulate.view import View


class SplatScene:
    """Gaussians drawn by the rasteriser; the scene's white is intensity 1."""

    def __init__(self, scene: Scene, threads: int = 1) -> None:
        self._scene = scene
        self._threads = threads
        self._rasteriser: AnyRasteriser | None = None

    def render(
        self,
        intrinsics: Intrinsics,
        width: int,
        height: int,
        rotation: NDArray[np.float64],
        centre: NDArray[np.float64],
    ) -> View:
        """See `ViewableScene.render`; the depth is that of the rasteriser, the mean over what a pixel sees."""
        camera = Camera(intrinsics, width, height)
        if self._rasteriser is None or self._rasteriser.camera != camera:
            self._rasteriser = rasteriser_for(camera, self._threads)
        image = self._rasteriser.forward(self._scene, rotation[None], centre[None])
        values = image.values.reshape(height, width, -1) / np.float32(self._scene.colour_of_white)
        return View(values, np.where(image.depth > 0, image.depth, np.inf).astype(np.float32))
