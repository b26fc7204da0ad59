"""Pictures and statistics of a few recorded frames."""

from dataclasses import dataclass
from enum import StrEnum

import cv2
import numpy as np
from numpy.typing import NDArray

from spiked.blocks import Window, aligned_window
from spiked.errors import RecordingError
from spiked.recon.mapping import fill_mosaic
from spiked.recording import Recording
from spiked.sensor import Sensor
from spiked_service.images import display_white

_MOMENT_FRAMES = 32
"""As short as 1.5 % noise of the charge between spikes allows: what moves is blurred over them."""
_COUNTED_FRAMES = 64
_ACCUMULATED_FRAMES = 1024
_EDGE_FRAMES = 64
"""Frames on either side in which the spikes that bound a window are looked for."""
_BINS = 64
_HOT_RATE = 0.3
"""Spikes a frame that a hot pixel fires above the median of those around it."""
_HOT_MOST = 64


class FrameNotRecordedError(RecordingError):
    """There is no such frame in the recording."""


class PictureKind(StrEnum):
    """What a picture shows."""

    INTERVAL = "interval"
    """Charge between spikes: the least noisy picture of a moment."""
    RATE = "rate"
    """Plain counts of a moment."""
    ACCUMULATION = "accumulation"
    """Plain counts of many frames."""
    RENDER = "render"
    """The reconstructed scene, as the camera saw it."""


@dataclass(frozen=True)
class Shot:
    """Recorded frames around one of them."""

    recording: Recording
    row: int
    """Of the frame in the middle, in the file."""
    first_frame: int
    """Absolute index of the file's first frame."""

    @property
    def sensor(self) -> Sensor:
        """Of the recording."""
        return self.recording.sensor

    @property
    def frame(self) -> int:
        """Absolute index of the frame in the middle."""
        return self.first_frame + self.recording.capture_index(self.row)

    def window(self, length: int) -> Window:
        """So many frames around it, or as many as there are."""
        frames = self.recording.frames
        length = min(length, frames)
        begin = min(max(0, self.row - length // 2), frames - length)
        first, last = max(0, begin - _EDGE_FRAMES), min(frames, begin + length + _EDGE_FRAMES)
        stored = np.ascontiguousarray(self.recording.read(first, last - first))
        return aligned_window(stored, self.sensor, first, begin, begin + length)


@dataclass(frozen=True)
class Picture:
    """Something to be encoded."""

    image: NDArray[np.float32]  # [H, W, C], C 1 or 3, spikes a frame
    white: float
    frame: int


@dataclass(frozen=True)
class Statistics:
    """How often pixels fire."""

    frame: int
    rate_histogram: list[int]
    """Pixels by rate, equal bins from 0 to 1 spike a frame."""
    hot_pixels: list[tuple[int, int]]
    """x, y of pixels that fire much more than those around them."""
    mean_rate: float


def shot_at(recording: Recording, frame: int | None, first_frame: int = 0) -> Shot:
    """The frames around the one with this absolute index, or those in the middle if None.

    `first_frame` is the absolute index of the recording's first one. Raises FrameNotRecordedError.
    """
    if frame is None:
        return Shot(recording, recording.frames // 2, first_frame)
    index = row = frame - first_frame
    for gap in sorted(recording.gaps, key=lambda gap: gap.first):
        if index < gap.first:
            break
        if index < gap.first + gap.count:
            raise RecordingError(
                f"frame {frame} was lost: {gap.count} frames are missing from {first_frame + gap.first} on"
            )
        row -= gap.count
    if not 0 <= row < recording.frames:
        last = first_frame + recording.capture_index(recording.frames - 1)
        raise FrameNotRecordedError(
            f"frame {frame} is not in the recording, which holds frames {first_frame} to {last}"
        )
    return Shot(recording, row, first_frame)


def picture(shot: Shot, kind: PictureKind, white: float | None) -> Picture:
    """A picture of recorded frames; `white` is found in it if not given."""
    sensor = shot.sensor
    if kind is PictureKind.INTERVAL:
        plane = shot.window(_MOMENT_FRAMES).rate(fill=True)
    else:
        plane = _rate(shot.window(_COUNTED_FRAMES if kind is PictureKind.RATE else _ACCUMULATED_FRAMES))
    channels = sensor.mosaic.channels(sensor.height, sensor.width) if sensor.mosaic else None
    image = fill_mosaic(plane, channels)
    return Picture(image, white or display_white(image), shot.frame)


def statistics(shot: Shot) -> Statistics:
    """Rates of the pixels over a moment."""
    rate = _rate(shot.window(_COUNTED_FRAMES))
    levels = (rate * 255).clip(0, 255).astype(np.uint8)
    excess = levels.astype(np.int16) - cv2.medianBlur(levels, 5)
    rows, columns = np.nonzero(excess > _HOT_RATE * 255)
    worst = np.argsort(-excess[rows, columns])[:_HOT_MOST]
    return Statistics(
        frame=shot.frame,
        rate_histogram=np.histogram(rate, _BINS, (0, 1))[0].tolist(),
        hot_pixels=[(int(columns[k]), int(rows[k])) for k in worst],
        mean_rate=float(rate.mean()),
    )


def _rate(window: Window) -> NDArray[np.float32]:
    rate: NDArray[np.float32] = window.count.astype(np.float32) / np.float32(window.end - window.begin)
    return rate
