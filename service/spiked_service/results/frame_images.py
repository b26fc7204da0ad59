"""Images and statistics of a few recorded frames."""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from spiked.blocks import Window, aligned_window
from spiked.errors import RecordingError
from spiked.recon.frontend.demosaic import fill_mosaic
from spiked.recording import Recording
from spiked.sensor import Intrinsics, Sensor
from spiked.undistortion import Undistortion
from spiked_service.results.image_encoding import display_white
from spiked_service.results.rate_statistics import RateStatistics, Region, statistics_of

_MOMENT_FRAMES = 32
"""Frames of an `interval` image: 1.5 % noise of the spike-aligned rate; motion is blurred over them."""
_COUNTED_FRAMES = 64
"""Frames of a `rate` image and of the statistics."""
_ACCUMULATED_FRAMES = 1024
"""Frames of an `accumulation` image."""
_READ_FRAMES = 256
"""Frames unpacked at a time."""
_EDGE_FRAMES = 64
"""Frames on either side of a window that are searched for the spikes that bound it."""


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
        """Spike-aligned window of `length` frames around it, or of all between the losses around it if fewer."""
        low, high = self.recording.unbroken(self.row)
        length = min(length, high - low)
        begin = min(max(low, self.row - length // 2), high - length)
        first, last = max(low, begin - _EDGE_FRAMES), min(high, begin + length + _EDGE_FRAMES)
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


def picture(window: FrameWindow, kind: PictureKind, white: float | None, lens: Intrinsics | None = None) -> Picture:
    """An image of recorded frames; `white` is the 99.5th percentile if None.

    With a `lens`: resampled to a camera of its focal length without its distortion; black where nothing was seen.
    """
    sensor = window.sensor
    if kind is PictureKind.INTERVAL:
        plane = window.aligned(_MOMENT_FRAMES).rate(fill=True)
    else:
        plane = _rate(window.aligned(_COUNTED_FRAMES if kind is PictureKind.RATE else _ACCUMULATED_FRAMES))
    channels = sensor.mosaic.channels(sensor.height, sensor.width) if sensor.mosaic else None
    image = fill_mosaic(plane, channels)
    if lens is not None and lens.distortion is not None:
        image = Undistortion.of(lens, sensor.width, sensor.height).straighten(image)
    return Picture(image, white or display_white(image), window.frame)


def statistics(window: FrameWindow, region: Region | None = None) -> RateStatistics:
    """Spike rates over `_COUNTED_FRAMES` frames. Raises NotInImageError."""
    aligned = window.aligned(_COUNTED_FRAMES)
    return statistics_of(aligned.count, aligned.end - aligned.begin, window.frame, region)


def spikes_of(window: FrameWindow, x: int, y: int, frames: int) -> tuple[int, list[int]]:
    """Absolute indices of the frames in which a pixel of the upright image fired, and that of the first one looked at.

    Looks at `frames` recorded frames around the middle one. Raises NotInImageError.
    """
    recording = window.recording
    Region(x, y, 1, 1).within(window.sensor.width, window.sensor.height)
    first = min(max(0, window.row - frames // 2), max(0, recording.frames - frames))
    last = min(recording.frames, first + frames)
    fired: list[int] = []
    for begin in range(first, last, _READ_FRAMES):
        images = recording.images(begin, min(_READ_FRAMES, last - begin))
        fired += [begin + int(row) for row in np.flatnonzero(images[:, y, x])]
    absolute = [window.first_frame + recording.capture_index(row) for row in fired]
    return window.first_frame + recording.capture_index(first), absolute


def _rate(window: Window) -> NDArray[np.float32]:
    rate: NDArray[np.float32] = window.count.astype(np.float32) / np.float32(window.end - window.begin)
    return rate
