"""Pictures of a comparison: what the camera observed, what each method renders, and the truth where it is known."""

import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from spiked.blocks import aligned_window
from spiked.errors import SceneError
from spiked.evaluate import best_gain
from spiked.rates import white_of
from spiked.recon.frontend.demosaic import fill_mosaic
from spiked.recording import Recording
from spiked.render import Camera, Rasteriser
from spiked.scene import Scene
from spiked.sensor import Image
from spiked.trajectory import Trajectory
from spiked_service.cli.comparison.cells import PICTURES, RESULT
from spiked_service.cli.comparison.inputs import HELD_OUT

WINDOW_FRAMES = 16
"""Frames of an observed picture: charge between spikes, as a person would look at it."""
SEARCH_FRAMES = 64
"""Frames on both sides that are searched for the spikes at its edges."""
TIMES = (0.25, 0.75)
"""Of the observed pictures, as shares of the recording."""
WIDTH_PX = 480
"""Largest width of a picture in the page."""
_QUALITY = 85
"""Of WebP."""


@dataclass(frozen=True)
class Strip:
    """Pictures of one place side by side."""

    title: str
    reference: str
    """What the first picture is: observed, or the truth."""
    pictures: dict[str, bytes]
    """WebP by row name; the reference under its own name. Rows without a picture are missing."""


def strips(recording: Recording, cells: dict[str, Path]) -> list[Strip]:
    """The strips of a recording; `cells` are folders of finished cells by row name."""
    found = [_observed_strip(recording, round(share * recording.frames), cells) for share in TIMES]
    return found + _true_strips(recording.path.parent / HELD_OUT, cells)


def observed(recording: Recording, frame: int) -> Image:
    """Spikes a frame [H, W, C] about a frame, colours interpolated."""
    begin = int(np.clip(frame - WINDOW_FRAMES // 2, 0, max(0, recording.frames - WINDOW_FRAMES)))
    end = min(recording.frames, begin + WINDOW_FRAMES)
    low, high = max(0, begin - SEARCH_FRAMES), min(recording.frames, end + SEARCH_FRAMES)
    sensor = recording.sensor
    rate = aligned_window(recording.read(low, high - low), sensor, low, begin, end).rate(fill=True)
    channels = None if sensor.mosaic is None else sensor.mosaic.channels(sensor.height, sensor.width)
    return fill_mosaic(rate, channels)


def rendered(recording: Recording, result: Path, frame: int) -> Image | None:
    """What a result shows at its own pose of a frame, [H, W, C]; None where it has no pose or no scene, or nobody
    stated the optics."""
    sensor = recording.sensor
    if sensor.intrinsics is None or not (result / "scene.ply").exists():
        return None
    path = Trajectory.read_tum(result / "trajectory.tum")
    (row,) = path.nearest(np.array([(frame + 0.5) / sensor.frame_rate_hz]), 1 / sensor.frame_rate_hz)
    if row < 0:
        return None
    camera = Camera(sensor.intrinsics, sensor.width, sensor.height)
    scene = Scene.read_ply(result / "scene.ply")
    values = Rasteriser(camera).forward(scene, path.rotations[row : row + 1], path.centres[row : row + 1]).values
    return values[..., None] if values.ndim == 2 else values


def _observed_strip(recording: Recording, frame: int, cells: dict[str, Path]) -> Strip:
    seen = observed(recording, frame)
    white = white_of(seen)
    pictures = {"observed": _webp(seen / white)}
    for name, folder in cells.items():
        image = rendered(recording, folder / RESULT, frame)
        if image is not None:
            image = image[..., : seen.shape[2]]
            pictures[name] = _webp(image * best_gain([image], truths=[seen]) / white)
    return Strip(f"frame {frame}, at each method's own pose", "observed", pictures)


def _true_strips(held_out: Path, cells: dict[str, Path]) -> list[Strip]:
    """The middle one of the held-out views on the path and of those beside it, as `spiked evaluate` drew them."""
    if not held_out.exists():
        return []
    try:
        views = [dict(view) for view in json.loads(held_out.read_bytes())["views"]]
        named = [(Path(view["file"]).stem, bool(view.get("on_trajectory", True))) for view in views]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise SceneError(f"cannot read the held-out views {held_out}: {error!r}") from error
    found = []
    for on_path, where in ((True, "on the path"), (False, "beside the path")):
        names = [name for name, lies_on_path in named if lies_on_path is on_path]
        if names:
            strip = _true_strip(names[len(names) // 2], where, cells)
            found += [] if strip is None else [strip]
    return found


def _true_strip(name: str, where: str, cells: dict[str, Path]) -> Strip | None:
    pictures: dict[str, bytes] = {}
    for row, folder in cells.items():
        for kind, key in (("truth", "truth"), ("render", row)):
            file = folder / PICTURES / f"{name}-{kind}.png"
            image = cv2.imread(str(file), cv2.IMREAD_COLOR_RGB) if file.exists() else None
            if image is not None:
                pictures.setdefault(key, _webp(np.asarray(image, np.float32) / np.float32(255)))
    return Strip(f"held-out view {name}, {where}", "truth", pictures) if pictures else None


def _webp(image: NDArray[np.float32]) -> bytes:
    """A picture [H, W, C] with white 1."""
    levels = np.rint(255 * np.clip(image, 0, 1)).astype(np.uint8)
    if levels.shape[1] > WIDTH_PX:
        height = round(levels.shape[0] * WIDTH_PX / levels.shape[1])
        levels = np.asarray(cv2.resize(levels, (WIDTH_PX, height), interpolation=cv2.INTER_AREA), np.uint8)
    bgr = levels[..., ::-1] if levels.ndim == 3 and levels.shape[2] == 3 else levels
    _, data = cv2.imencode(".webp", np.ascontiguousarray(bgr), [cv2.IMWRITE_WEBP_QUALITY, _QUALITY])
    return bytes(data)
