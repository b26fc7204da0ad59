"""Pictures of published scenes from any pose: scenes are read once, renderers kept, and only so many draw at a time."""

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
from spiked.render import Camera, Image
from spiked.render.cpu import Rasteriser, usable_cores
from spiked.scene import Scene
from spiked_service.limits import Gate

Floats = NDArray[np.float32]

_SCENES = 4
"""Scenes remembered: the newest versions of a few reconstructions."""
_CAMERAS = 4
"""Renderers that each slot keeps, by camera; their memory is then warm, which makes them 1.6 times as fast."""
_KEPT_PIXELS = 1_200_000
"""Renderers of larger pictures are not kept: theirs are some 100 MB."""


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
    """Camera to world, OpenCV axes."""

    rotation: NDArray[np.float64]  # [3, 3]
    centre: NDArray[np.float64]  # [3]


class _Slot:
    """Renderers for one request at a time."""

    def __init__(self) -> None:
        self._rasterisers: OrderedDict[Camera, Rasteriser] = OrderedDict()

    def draw(self, scene: Scene, camera: Camera, pose: Pose) -> Image:
        rasteriser = self._rasterisers.pop(camera, None) or Rasteriser(camera, threads=1)
        if camera.width * camera.height <= _KEPT_PIXELS:
            self._rasterisers[camera] = rasteriser
        if len(self._rasterisers) > _CAMERAS:
            self._rasterisers.popitem(last=False)
        return rasteriser.forward(scene, pose.rotation[None], pose.centre[None])


class ViewRenderer:
    """Renders with one thread for each of a few requests at a time; the others wait their turn, up to a limit.

    Blocks while it renders: not for an event loop. The renderer's own code runs without Python's lock.
    """

    def __init__(self, gate: Gate, concurrent: int | None = None) -> None:
        """`concurrent` renders at a time (as many as cores if not given); the gate limits those who wait as well."""
        self._gate = gate
        self._slots = [_Slot() for _ in range(concurrent or usable_cores())]
        self._turn = threading.Condition()
        self._scenes = _Scenes()

    def render(self, scene: Path, camera: Camera, pose: Pose) -> Image:
        """What a camera sees of the scene in a PLY file. Raises SceneError if it is gone, OverloadedError."""
        with self._gate(), self._slot() as slot:
            return slot.draw(self._scenes.get(scene), camera, pose)

    @contextmanager
    def _slot(self) -> Iterator[_Slot]:
        with self._turn:
            self._turn.wait_for(lambda: bool(self._slots))
            slot = self._slots.pop()  # the one used last, whose memory is warm
        try:
            yield slot
        finally:
            with self._turn:
                self._slots.append(slot)
                self._turn.notify()


class _Scenes:
    """The scenes used last. Each is read by one thread, and the others wait for it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._known: OrderedDict[tuple[Path, int, int], _Once] = OrderedDict()

    def get(self, path: Path) -> Scene:
        try:
            stat = path.stat()
        except OSError as error:
            raise SceneError(f"the scene {path.name} is not there any more: {error.strerror}; ask again") from error
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


def shown(image: Image, output: Output, background: tuple[float, float, float]) -> Floats:
    """The plane of an output, [H, W] or [H, W, 3]; `background` is radiance, red, green, blue."""
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
