"""What a report is made of, wherever the result lies: in an output folder, or in the data folder of the service."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spiked.errors import RecordingError
from spiked.recon.statistics import evenly
from spiked.recording import Recording
from spiked.sensor import Sensor
from spiked.trajectory import Trajectory
from spiked_service.results.frame_images import PictureKind, frame_window_at, picture
from spiked_service.results.image_encoding import ImageFormat, encode
from spiked_service.results.report.figures import Figures
from spiked_service.results.timeline import frames_at
from spiked_service.results.view_renderer import Pose

PICTURES = 4
"""Moments of the path that are shown."""
MOST_DRAWN = 4000
"""Poses of a path in its plots: two for each pixel of a wide screen."""

Pieces = Callable[[], Iterable[Trajectory]]
"""The poses of a path, piece by piece, each time from its beginning."""
Render = Callable[[Pose], NDArray[np.float32]]
"""The radiance [H, W] or [H, W, 3] that the scene shows from a pose."""


@dataclass(frozen=True)
class Pair:
    """What the camera saw at a time, and what the scene shows from there, each as PNG and as WebP."""

    time_s: float
    observed: Mapping[ImageFormat, bytes] | None
    rendered: Mapping[ImageFormat, bytes] | None


@dataclass(frozen=True)
class ReportSource:
    """One result with all that is known of it."""

    name: str
    """Of the result, for titles and file names."""
    document: Mapping[str, Any]
    """The content of report.json, `without_folders`."""
    figures: Figures
    at: datetime
    """When the result was made."""
    path: Trajectory
    """At most `MOST_DRAWN` of its poses; empty if none was found."""
    poses: int
    pieces: Pieces
    tum: Path | None
    """The file that they were read from, if it is one."""
    sensor: Sensor | None
    incomplete: str | None = None
    """Why the result is not the end of the run."""
    recording_name: str = ""
    scene: Path | None = None
    pairs: list[Pair] = field(default_factory=list)
    others: Mapping[str, Pieces] = field(default_factory=dict)
    """Paths of all recordings of a map of several, by name."""
    sidecar: Path | None = None
    recording: Path | None = None
    """The file of frames, if it belongs into the bundle."""


def without_folders(found: Any) -> Any:
    """JSON with the names of files in place of their absolute paths: what is shared names no folder of its machine."""
    if isinstance(found, Mapping):
        return {name: without_folders(value) for name, value in found.items()}
    if isinstance(found, list):
        return [without_folders(value) for value in found]
    return Path(found).name if isinstance(found, str) and found.startswith("/") else found


def thinned(count: int) -> range:
    """Rows of at most `MOST_DRAWN` poses, evenly spread over `count`."""
    return range(0, count, max(1, -(-count // MOST_DRAWN)))


def pairs(
    path: Trajectory, white: float, render: Render | None, recording: Recording | None, first_frame: int = 0
) -> list[Pair]:
    """Pictures at times spread over a path; observed ones if the recording is at hand, which begins with `first_frame`
    of its capture."""
    shown = []
    for row in evenly(len(path), PICTURES):
        time_s = float(path.times_s[row])
        seen = None if recording is None else _observed(recording, time_s, first_frame)
        made = None if render is None else render(Pose(path.rotations[row], path.centres[row]))
        shown.append(Pair(time_s, _encoded(seen, white), _encoded(made, white)))
    return [one for one in shown if one.observed is not None or one.rendered is not None]


def _observed(recording: Recording, time_s: float, first_frame: int) -> NDArray[np.float32] | None:
    frame = int(frames_at(np.array([time_s]), recording.sensor.frame_rate_hz)[0])
    try:
        return picture(frame_window_at(recording, frame, first_frame), PictureKind.INTERVAL, None).image
    except RecordingError:  # the frame was lost
        return None


def _encoded(image: NDArray[np.float32] | None, white: float) -> Mapping[ImageFormat, bytes] | None:
    if image is None:
        return None
    return {kind: encode(image, kind, white) for kind in (ImageFormat.PNG, ImageFormat.WEBP)}
