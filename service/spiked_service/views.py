"""Pictures of published scenes from any pose."""

import threading
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from spiked.render import Camera
from spiked.render.cpu import Rasteriser
from spiked.scene import Scene
from spiked_service.publication import Published


class ViewRenderer:
    """Renders with one thread, so that the reconstruction keeps its cores, and remembers the last scene it read.

    Blocks while it renders: not for an event loop.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._path: Path | None = None
        self._scene: Scene | None = None

    def render(
        self,
        folder: Path,
        published: Published,
        camera: Camera,
        rotation: NDArray[np.float64],
        centre: NDArray[np.float64],
    ) -> NDArray[np.float32]:
        """Radiance [H, W] or [H, W, 3] from a camera-to-world pose. Raises SceneError if the version is gone."""
        with self._lock:
            path = folder / published.scene
            if self._scene is None or path != self._path:
                self._scene, self._path = Scene.read_ply(path), path
            return Rasteriser(camera, threads=1).forward(self._scene, rotation[None], centre[None]).values
