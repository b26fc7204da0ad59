"""Renders published scenes from any pose; scenes and rasterisers are cached, concurrent renders are limited."""

import threading
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from spiked.errors import SceneError
from spiked.render import Camera, RenderedImage
from spiked.render.cpu import Rasteriser, usable_cores
from spiked.scene import Scene
from spiked_service.base.limits import ConcurrencyLimit

Floats = NDArray[np.float32]

_SCENES = 4
"""Scenes in the cache: the newest versions of a few reconstructions."""
_CAMERAS = 4
"""Rasterisers that each slot caches, by camera; with warm memory they are 1.6 times as fast."""
_KEPT_PIXELS = 1_200_000
"""Rasterisers of images with more pixels are not cached: they take about 100 MB."""


class Output(StrEnum):
    """What a view shows."""

    COLOR = "color"
    """Radiance, expected spikes a frame."""
    DEPTH = "depth"
    """Expected z along the camera's axis, in the scene's unit of length; 0 where nothing is."""
    ALPHA = "alpha"
    """How opaque the scene is, 0 to 1."""


@dataclass(frozen=True)
class Pose:
    """Camera-to-world pose with OpenCV axes."""

    rotation: NDArray[np.float64]  # [3, 3]
    centre: NDArray[np.float64]  # [3]


class _Slot:
    """Cached rasterisers for one request at a time."""

    def __init__(self) -> None:
        self._rasterisers: OrderedDict[Camera, Rasteriser] = OrderedDict()

    def draw(self, scene: Scene, camera: Camera, pose: Pose) -> RenderedImage:
        rasteriser = self._rasterisers.pop(camera, None) or Rasteriser(camera, threads=1)
        if camera.width * camera.height <= _KEPT_PIXELS:
            self._rasterisers[camera] = rasteriser
        if len(self._rasterisers) > _CAMERAS:
            self._rasterisers.popitem(last=False)
        return rasteriser.forward(scene, pose.rotation[None], pose.centre[None])


class ViewRenderer:
    """Renders each request with one thread, a few requests at a time; others wait, up to a limit.

    Blocks while it renders, so it must not be called on an event loop. The rasteriser releases the GIL.
    """

    def __init__(self, concurrency: ConcurrencyLimit, concurrent: int | None = None) -> None:
        """`concurrent`: renders at a time, by default one per core; `concurrency` counts waiting requests too."""
        self._concurrency = concurrency
        self._slots = [_Slot() for _ in range(concurrent or usable_cores())]
        self._turn = threading.Condition()
        self._scenes = _Scenes()

    def render(self, scene: Path, camera: Camera, pose: Pose) -> RenderedImage:
        """Render the scene in a PLY file. Raises SceneError if the file was removed, OverloadedError."""
        with self._concurrency(), self._slot() as slot:
            return slot.draw(self._scenes.get(scene), camera, pose)

    @contextmanager
    def _slot(self) -> Iterator[_Slot]:
        with self._turn:
            self._turn.wait_for(lambda: bool(self._slots))
            slot = self._slots.pop()  # used last, so its memory is warm
        try:
            yield slot
        finally:
            with self._turn:
                self._slots.append(slot)
                self._turn.notify()


class _Scenes:
    """Cache of the scenes used last. Each scene is read by one thread, and others wait for it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._known: OrderedDict[tuple[Path, int, int], _Once] = OrderedDict()

    def get(self, path: Path) -> Scene:
        try:
            stat = path.stat()
        except OSError as error:
            raise SceneError(
                f"the scene {path.name} was removed: {error.strerror}; request the newest version"
            ) from error
        key = path, stat.st_ino, stat.st_mtime_ns  # a restarted reconstruction uses its names again
        with self._lock:
            once = self._known.setdefault(key, _Once())
            self._known.move_to_end(key)
            if len(self._known) > _SCENES:
                self._known.popitem(last=False)
        return once.read(path)


class _Once:
    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._scene: Scene | None = None

    def read(self, path: Path) -> Scene:
        with self._lock:
            if self._scene is None:
                self._scene = Scene.read_ply(path)
            return self._scene


def shown(image: RenderedImage, output: Output, background: tuple[float, float, float]) -> Floats:
    """The image of an output, [H, W] or [H, W, 3], over a background of radiance (red, green, blue)."""
    match output:
        case Output.DEPTH:
            return image.depth
        case Output.ALPHA:
            return image.alpha
        case Output.COLOR:
            if not any(background):
                return image.values
            behind = np.array(background, np.float32)
            through = 1 - image.alpha
            if image.values.ndim == 2 and (behind == behind[0]).all():
                grey: Floats = image.values + through * behind[0]
                return grey
            values = image.values if image.values.ndim == 3 else image.values[..., None]
            coloured: Floats = values + through[..., None] * behind
            return coloured
