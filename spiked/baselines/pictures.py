"""Pictures made of spikes, as pipelines for ordinary cameras take them: 8 bits, grey, at evenly spaced times."""

from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum

import cv2
import numpy as np
from numpy.typing import NDArray

from spiked.blocks import Window, aligned_window
from spiked.errors import ConfigurationError
from spiked.rates import white_of
from spiked.recording import Recording
from spiked.sensor import Image, Intrinsics, Sensor

__all__ = ["ImageKind", "PictureOptions", "SpikePicture", "spike_pictures"]

SEARCH_FRAMES = 64
"""Frames on both sides of a window that are searched for the spikes nearest to its edges: a pixel at 1.5 % of white."""
WINDOWS = (32, 16, 8, 4)
"""Lengths of a window in frames that are tried, longest first."""
LEAST_PICTURES = 35
"""Windows one after another that a recording has to have, at least, for a length of window to be taken."""
PICTURES = 60
"""Pictures of a recording unless their number is chosen; if it is short, windows overlap by up to half: on 1,280 frames
COLMAP's error is a quarter smaller than with 40 pictures (decision 34)."""


class ImageKind(StrEnum):
    """How spikes become a picture."""

    TFP = "tfp"
    """Texture from playback: the mean of the frames of a window."""
    TFI = "tfi"
    """Texture from interval: the reciprocal of the interval between the two spikes about the window's middle."""
    CHARGE = "charge"
    """Charge between the spikes nearest to the window's edges, over the time between them."""


@dataclass(frozen=True)
class PictureOptions:
    """Which pictures are made of a recording."""

    kind: ImageKind = ImageKind.TFP
    window_frames: int | None = None
    """Frames of a picture; None takes the longest of 32, 16, 8 and 4 that the recording has 35 of."""
    pictures: int | None = None
    """Number of pictures, evenly spaced; None takes 60, or fewer if windows would overlap by more than half."""

    def windows(self, frames: int) -> list[tuple[int, int]]:
        """First and last + 1 frame of each picture of a recording of `frames` frames. Raises ConfigurationError."""
        length = self.window_frames or next((n for n in WINDOWS if frames // n >= LEAST_PICTURES), WINDOWS[-1])
        count = self.pictures or min(PICTURES, 2 * frames // length)
        if length < 1 or count < 2 or length + count - 1 > frames:
            raise ConfigurationError(
                f"{frames} frames do not give {max(count, 2)} pictures of {length} frames: use a longer recording, "
                "--window-frames or --pictures"
            )
        begins = np.linspace(0, frames - length, count).round().astype(int)
        return [(int(begin), int(begin) + length) for begin in begins]


@dataclass(frozen=True)
class SpikePicture:
    """A grey picture, uint8 [h, w], at the time of its middle in frames of the recording."""

    time: float
    pixels: NDArray[np.uint8]


def bin_pixels(sensor: Sensor) -> int:
    """Sensor pixels along an edge of a picture's pixel: 2 for a mosaic, so that a pixel has all its colours."""
    return 1 if sensor.mosaic is None else 2


def picture_intrinsics(sensor: Sensor) -> Intrinsics:
    """The optics of the pictures. Raises ConfigurationError where the recording does not state its own."""
    if sensor.intrinsics is None:
        raise ConfigurationError(
            "a baseline needs the focal length, and the recording does not state it: give --fov or --intrinsics"
        )
    return sensor.intrinsics.scaled(1 / bin_pixels(sensor))


def spike_pictures(recording: Recording, options: PictureOptions) -> Iterator[SpikePicture]:
    """The pictures of a recording in the order of time, all with the same white.

    Times and frames are those of the stored frames; a recording with gaps has to be cut before. Raises
    ConfigurationError.
    """
    if recording.gaps:
        raise ConfigurationError(
            f"{recording.path} misses frames, and pictures across a gap mean nothing; cut it with `spiked convert`"
        )
    white = 0.0
    for begin, end in options.windows(recording.frames):
        low, high = max(0, begin - SEARCH_FRAMES), min(recording.frames, end + SEARCH_FRAMES)
        frames = recording.read(low, high - low)
        rate = _binned(_rate(frames, recording.sensor, options.kind, (low, begin, end)), bin_pixels(recording.sensor))
        white = white or white_of(rate)
        # Linear: a tone curve raises the noise in the shadows, and COLMAP then finds a wrong path (decision 34).
        yield SpikePicture(0.5 * (begin + end), np.rint(255 * np.clip(rate / white, 0, 1)).astype(np.uint8))


def _rate(frames: NDArray[np.uint8], sensor: Sensor, kind: ImageKind, span: tuple[int, int, int]) -> Image:
    """Spikes a frame [H, W] in the window [begin, end) of frames that start at `low`; span is (low, begin, end)."""
    low, begin, end = span
    if kind is ImageKind.TFP:
        return aligned_window(frames, sensor, low, begin, end).count.astype(np.float32) / np.float32(end - begin)
    if kind is ImageKind.TFI:
        middle = (begin + end) // 2
        return _bounded(aligned_window(frames, sensor, low, middle, middle + 1))
    return _bounded(aligned_window(frames, sensor, low, begin, end))


def _bounded(window: Window) -> Image:
    """The rate; half of its upper bound where no interval was found."""
    return window.rate(fill=True)


def _binned(rate: Image, size: int) -> Image:
    if size == 1:
        return rate
    height, width = rate.shape[0] // size * size, rate.shape[1] // size * size
    small = cv2.resize(rate[:height, :width], (width // size, height // size), interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.float32)
