"""A recording in slow motion: rate images of a few frames each, if wanted averaged along the motion of the image.

A picture is the charge between the spikes at both edges of its window. Motion compensation adds the windows before and
after it, moved onto it along dense optical flow (Kroeger et al., Fast optical flow using dense inverse search, ECCV
2016), where the flow there and back agrees: less noise at the same blur (`evaluation/slow_motion_figures.py`).
"""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from spiked.errors import ConfigurationError
from spiked.rates import levels, rate_at, white_of
from spiked.recording import Recording
from spiked.sensor import Image

__all__ = ["SlowMotion", "slow_motion"]

WINDOW = 16
"""Frames of a picture unless chosen: 3 % noise of a bright pixel, and 0.8 ms at 20,000 frames a second."""
LONGEST = 4096
"""Frames of a picture, at most."""
MOST_PICTURES = 1_000_000
"""Of a video: nine hours."""
SIDES = 1
"""Windows on each side of a picture that motion compensation adds."""
MISSED_PX = 0.5
"""Flow there and back that misses by this much: half of the weight of a pixel is lost."""
UNLIKE = 0.05
"""Difference, as a share of white, at which half of the weight of a pixel is lost: it is another surface."""


@dataclass(frozen=True)
class SlowMotion:
    """How a recording is shown."""

    slower: float
    """Seconds of video for a second of recording."""
    pictures_a_second: float = 30.0
    window: int = WINDOW
    """Frames of a picture."""
    compensated: bool = False
    """Whether neighbouring windows are moved onto each picture and averaged with it."""
    begin_s: float = 0.0
    """Time of the capture at which it begins."""
    end_s: float | None = None
    """At which it ends; None: with the recording."""

    def times_s(self, recording: Recording) -> NDArray[np.float64]:
        """Times of the capture of the pictures [n]. Raises ConfigurationError for a range without a picture."""
        if not self.slower > 0 or not 1 <= self.window <= LONGEST:
            raise ConfigurationError(
                f"slow motion needs a factor above 0 and a window of 1 to {LONGEST} frames, "
                f"not {self.slower:g} and {self.window}"
            )
        begin, end = self._range_s(recording)
        count = int(np.floor((end - begin) * self.slower * self.pictures_a_second + 1e-6))
        if count < 1:
            raise ConfigurationError(
                f"{end - begin:g} s, {self.slower:g} times slower, are less than one picture: a larger factor has more"
            )
        if count > MOST_PICTURES:
            raise ConfigurationError(
                f"{end - begin:g} s, {self.slower:g} times slower, are {count:,} pictures, more than "
                f"{MOST_PICTURES:,}: take a part of the recording, or a smaller factor"
            )
        return begin + np.arange(0.5, count) / (self.slower * self.pictures_a_second)

    def duration_s(self, recording: Recording) -> float:
        """Seconds of the recording that are shown. Raises ConfigurationError if there are none."""
        begin, end = self._range_s(recording)
        return end - begin

    def _range_s(self, recording: Recording) -> tuple[float, float]:
        rate_hz = recording.sensor.frame_rate_hz
        first = recording.capture_index(0) / rate_hz
        last = (recording.capture_index(recording.frames - 1) + 1) / rate_hz
        begin, end = max(first, self.begin_s), min(last, last if self.end_s is None else self.end_s)
        if not begin < end:
            raise ConfigurationError(
                f"the recording is of {first:g} s to {last:g} s, and none of it lies between {self.begin_s:g} s and "
                f"{'its end' if self.end_s is None else f'{self.end_s:g} s'}"
            )
        return begin, end


def slow_motion(recording: Recording, how: SlowMotion) -> Iterator[NDArray[np.uint8] | None]:
    """The pictures, uint8 [H, W], RGB [H, W, 3] of a mosaic; linear, white as bright as all but the brightest of the
    first picture. None where frames were lost. Raises ConfigurationError."""
    white = 0.0
    for time_s in how.times_s(recording):
        rate = rate_at(recording, float(time_s), how.window)
        if rate is None:
            yield None
            continue
        white = white or white_of(rate)
        if how.compensated:
            rate = compensated(recording, float(time_s), how.window, rate, white)
        yield levels(rate[..., 0] if rate.shape[2] == 1 else rate, white)


def compensated(recording: Recording, time_s: float, window: int, rate: Image, white: float) -> Image:
    """The rate [H, W, C] of a window around a time of the capture, averaged with its neighbours, each moved onto it."""
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    height, width = rate.shape[:2]
    grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).astype(np.float32)
    here = _for_flow(rate, white)
    total, weights = rate.copy(), np.ones((height, width, 1), np.float32)
    for side in (-1, 1):
        there: NDArray[np.float32] | None = None
        for step in range(1, SIDES + 1):
            other = rate_at(recording, time_s + side * step * window / recording.sensor.frame_rate_hz, window)
            if other is None:
                break
            seen = _for_flow(other, white)
            there = flow.calc(here, seen, there)
            back = flow.calc(seen, here, None)
            at = grid + there
            missed = there + cv2.remap(back, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            moved = cv2.remap(other, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            moved = moved.reshape(height, width, -1)
            inside = ((at >= 0) & (at <= (width - 1, height - 1))).all(2)
            unlike = cv2.GaussianBlur(np.abs(moved - rate).mean(2), (5, 5), 0) / (UNLIKE * white)
            weight = inside / (1 + np.square(missed / MISSED_PX).sum(2)) / (1 + unlike**2)
            total += weight[..., None] * moved
            weights += weight[..., None]
    return np.asarray(total / weights, np.float32)


def _for_flow(rate: Image, white: float) -> NDArray[np.uint8]:
    """Grey [H, W] of 8 bits in which dark places have contrast, smoothed of its noise."""
    grey = np.sqrt(np.clip(rate.mean(2) / white, 0, 1))
    return np.asarray(np.round(255 * cv2.GaussianBlur(grey, (0, 0), 1.0)), np.uint8)
