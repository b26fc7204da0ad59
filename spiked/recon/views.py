"""From frames as they arrive to views: spike-aligned rate images of short windows, with the noise of each pixel."""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from spiked.blocks import Window, aligned_window
from spiked.calibration import Calibration
from spiked.sensor import Mosaic, Sensor

Image = NDArray[np.float32]

MARGIN = 24
"""Frames looked at on both sides of a window for the spikes nearest to its edges."""


@dataclass(frozen=True)
class View:
    """What the camera saw in the frames [begin, end); images are upright [H, W]."""

    begin: int
    end: int
    rate: Image
    """Spikes a frame; where no whole interval was seen, half of the rate's upper bound."""
    deviation: Image
    """Standard deviation of `rate`."""
    delay: NDArray[np.float16]
    """Frames from the middle of the window to the middle of the charge that `rate` was measured from."""
    duration: NDArray[np.float16]
    """Frames over which that charge came together."""
    spikes_a_pixel: float
    """Mean plain count."""
    after_gap: bool = False
    """Frames are missing between the view before and this one."""

    @property
    def time(self) -> float:
        """The middle of the window in frames."""
        return 0.5 * (self.begin + self.end)

    def exposure(self, parts: int) -> tuple[NDArray[np.float64], Image]:
        """When each pixel gathered its charge, for `Rasteriser.forward_moving` with `parts` sub-frames.

        Returns the times [parts + 1] in frames at which the camera's poses are wanted, evenly spaced over what most
        pixels looked at, and the pixels' windows [2, H, W] in units of these.
        """
        half = 0.5 * self.duration.astype(np.float32)
        start, stop = self.delay - half, self.delay + half
        first, last = np.percentile(start[::4, ::4], 2), np.percentile(stop[::4, ::4], 98)
        scale = np.float32(parts / max(last - first, 1e-3))
        windows = np.stack([(start - np.float32(first)) * scale, (stop - np.float32(first)) * scale])
        np.clip(windows[0], 0, parts - 0.02, out=windows[0])
        np.clip(windows[1], windows[0] + 0.02, parts, out=windows[1])
        return self.time + np.linspace(first, last, parts + 1), windows.astype(np.float32)


def make_view(window: Window, after_gap: bool, calibration: Calibration | None = None) -> View:
    """The view of a spike-aligned window, in light instead of spikes where the camera is calibrated."""
    rate = window.rate(fill=True)
    variance = np.nan_to_num(window.variance(jitter=1.2e-3), nan=0.0)
    deviation = np.where(window.valid, np.sqrt(variance), window.rate_bound()).astype(np.float32)
    if calibration is not None:
        rate, deviation = calibration.apply(rate, deviation)
    middle = 0.5 * (window.begin + window.end)
    delay = np.nan_to_num(window.centre() - middle, nan=0.0).astype(np.float16)
    duration = np.where(window.valid, window.duration(), window.end - window.begin).astype(np.float16)
    return View(window.begin, window.end, rate, deviation, delay, duration, float(window.count.mean()), after_gap)


class Windows:
    """Cuts a stream of frames into views of `length` frames, one every `hop` frames. Windows never span a gap."""

    def __init__(self, sensor: Sensor, length: int, hop: int, calibration: Calibration | None = None) -> None:
        """Raises CalibrationError when the calibration is of another sensor."""
        self.sensor, self.length, self.hop = sensor, length, hop
        self._calibration = calibration
        if calibration is not None:
            calibration.check(sensor)
        self._frames = np.zeros((0, sensor.frame_bytes), np.uint8)
        self._first = 0
        self._next = 0
        self._gap = False

    def feed(self, first_frame: int, frames: NDArray[np.uint8]) -> Iterator[View]:
        """Take frames uint8 [n, frame_bytes] in stored layout and yield the views that they complete."""
        expected = self._first + len(self._frames)
        if first_frame != expected:
            yield from self._cut(final=True)
            self._gap = self._gap or expected > 0
            self._frames, self._first, self._next = self._frames[:0], first_frame, first_frame
        self._frames = np.concatenate([self._frames, frames]) if len(self._frames) else frames
        yield from self._cut(final=False)

    def flush(self) -> Iterator[View]:
        """The last views, whose right margin never came."""
        yield from self._cut(final=True)

    def _cut(self, final: bool) -> Iterator[View]:
        stop = self._first + len(self._frames)
        while self._next + self.length + (0 if final else MARGIN) <= stop:
            begin, end = self._next, self._next + self.length
            low = max(self._first, begin - MARGIN)
            high = min(stop, end + MARGIN)
            part = self._frames[low - self._first : high - self._first]
            view = make_view(aligned_window(part, self.sensor, low, begin, end), self._gap, self._calibration)
            self._gap = False
            self._next += self.hop
            yield view
        keep = max(self._first, min(self._next - MARGIN, stop))
        self._frames, self._first = self._frames[keep - self._first :].copy(), keep


def luminance(rate: Image, mosaic: Mosaic | None) -> Image:
    """A grey image of raw sites: a 3x3 binomial mean sees every colour in the same proportion at every pixel."""
    if mosaic is None:
        return rate
    row = np.array([0.25, 0.5, 0.25], np.float32)
    return np.asarray(cv2.sepFilter2D(rate, cv2.CV_32F, row, row, borderType=cv2.BORDER_REFLECT_101), np.float32)
