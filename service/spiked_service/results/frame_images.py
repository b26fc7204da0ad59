"""Images and statistics of a few recorded frames."""

from dataclasses import dataclass
from enum import StrEnum

import cv2
import numpy as np
from numpy.typing import NDArray

from spiked.blocks import Window, aligned_window
from spiked.errors import RecordingError
from spiked.recon.frontend.demosaic import fill_mosaic
from spiked.recording import Recording
from spiked.sensor import Sensor
from spiked.undistortion import Undistortion
from spiked_service.results.image_encoding import display_white

_MOMENT_FRAMES = 32
"""Frames of an `interval` image: 1.5 % noise of the spike-aligned rate; motion is blurred over them."""
_COUNTED_FRAMES = 64
"""Frames of a `rate` image and of the statistics."""
_ACCUMULATED_FRAMES = 1024
"""Frames of an `accumulation` image."""
_EDGE_FRAMES = 64
"""Frames on either side of a window that are searched for the spikes that bound it."""
_BINS = 64
"""Bins of the histogram of rates, 0 to 1 spike a frame."""
_HOT_RATE = 0.3
"""Excess rate of a hot pixel over the median of its 5x5 neighbours, spikes per frame."""
_HOT_MOST = 64
"""Hot pixels listed, the worst first."""


class FrameNotRecordedError(RecordingError):
    """The recording does not hold the frame."""


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
class FrameWindow:
    """A recorded frame and its neighbours."""

    recording: Recording
    row: int
    """Row of the middle frame in the file."""
    first_frame: int
    """Absolute index of the file's first frame."""

    @property
    def sensor(self) -> Sensor:
        """Sensor of the recording."""
        return self.recording.sensor

    @property
    def frame(self) -> int:
        """Absolute index of the middle frame."""
        return self.first_frame + self.recording.capture_index(self.row)

    def aligned(self, length: int) -> Window:
        """Spike-aligned window of `length` frames around it, or of all if the recording has fewer."""
        frames = self.recording.frames
        length = min(length, frames)
        begin = min(max(0, self.row - length // 2), frames - length)
        first, last = max(0, begin - _EDGE_FRAMES), min(frames, begin + length + _EDGE_FRAMES)
        stored = np.ascontiguousarray(self.recording.read(first, last - first))
        return aligned_window(stored, self.sensor, first, begin, begin + length)


@dataclass(frozen=True)
class Picture:
    """An image of some frames."""

    image: NDArray[np.float32]  # [H, W, C], C 1 or 3, spikes per frame
    white: float
    """Value shown as white, spikes per frame."""
    frame: int
    """Absolute index of the middle frame."""


@dataclass(frozen=True)
class Statistics:
    """Spike rates of the pixels."""

    frame: int
    rate_histogram: list[int]
    """Number of pixels by rate, in 64 equal bins from 0 to 1 spike per frame."""
    hot_pixels: list[tuple[int, int]]
    """x, y of pixels that fire much more often than their neighbours, at most 64."""
    mean_rate: float
    """Spikes per pixel and frame."""


def frame_window_at(recording: Recording, frame: int | None, first_frame: int = 0) -> FrameWindow:
    """The frames around absolute index `frame`, or around the middle of the recording if None.

    `first_frame` is the absolute index of the first recorded frame. Raises FrameNotRecordedError for a frame outside
    of the recording, RecordingError for a lost one.
    """
    if frame is None:
        return FrameWindow(recording, recording.frames // 2, first_frame)
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
    return FrameWindow(recording, row, first_frame)


def picture(window: FrameWindow, kind: PictureKind, white: float | None, undistorted: bool = False) -> Picture:
    """An image of recorded frames; `white` is the 99.5th percentile if None.

    `undistorted`: resampled to a camera of the same focal length without distortion; black where nothing was seen.
    """
    sensor = window.sensor
    if kind is PictureKind.INTERVAL:
        plane = window.aligned(_MOMENT_FRAMES).rate(fill=True)
    else:
        plane = _rate(window.aligned(_COUNTED_FRAMES if kind is PictureKind.RATE else _ACCUMULATED_FRAMES))
    channels = sensor.mosaic.channels(sensor.height, sensor.width) if sensor.mosaic else None
    image = fill_mosaic(plane, channels)
    k = sensor.intrinsics
    if undistorted and k is not None and k.distortion is not None:
        image = Undistortion.of(k, sensor.width, sensor.height).straighten(image)
    return Picture(image, white or display_white(image), window.frame)


def statistics(window: FrameWindow) -> Statistics:
    """Spike rates over `_COUNTED_FRAMES` frames."""
    rate = _rate(window.aligned(_COUNTED_FRAMES))
    levels = (rate * 255).clip(0, 255).astype(np.uint8)
    excess = levels.astype(np.int16) - cv2.medianBlur(levels, 5)
    rows, columns = np.nonzero(excess > _HOT_RATE * 255)
    worst = np.argsort(-excess[rows, columns])[:_HOT_MOST]
    return Statistics(
        frame=window.frame,
        rate_histogram=np.histogram(rate, _BINS, (0, 1))[0].tolist(),
        hot_pixels=[(int(columns[k]), int(rows[k])) for k in worst],
        mean_rate=float(rate.mean()),
    )


def _rate(window: Window) -> NDArray[np.float32]:
    rate: NDArray[np.float32] = window.count.astype(np.float32) / np.float32(window.end - window.begin)
    return rate
