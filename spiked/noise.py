"""Measures the noise of a camera's counts and charges from a recording of a static scene."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spiked.blocks import aligned_window, unpack
from spiked.errors import RecordingError
from spiked.recording import Recording
from spiked.sensor import Sensor

__all__ = ["NoiseReport", "WindowNoise", "measure_noise"]

LENGTHS = (4, 8, 16, 32, 64)
"""Frames of the windows that are compared."""
MARGIN = 32
"""Frames on both sides of a window that are searched for the spikes nearest to its edges."""
LEAST_WINDOWS = 4
"""Fewest windows of one length for its variance."""
LEAST_SPIKES = 8
"""Fewest intervals of a pixel for an estimate of its spread."""


@dataclass(frozen=True)
class WindowNoise:
    """Noise of the rates in windows of so many frames; relative errors are medians over the pixels."""

    frames: int
    windows: int
    variance: float
    """Of the number of spikes of a pixel in a window, mean over the pixels."""
    binomial_variance: float
    """The value for independent (Poisson) spikes."""
    counted: float
    """Relative standard deviation of spikes / frames."""
    charge: float
    """Relative standard deviation of the rate between the first and the last spike around the window."""


@dataclass(frozen=True)
class NoiseReport:
    """See `measure_noise`."""

    frames: int
    rate: float
    """Spikes a frame, mean over all pixels."""
    interval: float
    """Frames from spike to spike, median over the pixels."""
    jitter: float
    """Standard deviation of these within a pixel, in frames, median over the pixels."""
    windows: tuple[WindowNoise, ...]


def measure_noise(recording: Recording, most_frames: int = 2048) -> NoiseReport:
    """Noise in the first `most_frames` frames, in which the scene must be static, with constant light.

    Raises RecordingError for recordings of less than 4 windows of the shortest length, and for dark ones.
    """
    count = min(recording.frames, most_frames)
    frames = recording.read(0, count)
    lengths = [length for length in LENGTHS if (count - 2 * MARGIN) // length >= LEAST_WINDOWS]
    if not lengths:
        least = LENGTHS[0] * LEAST_WINDOWS + 2 * MARGIN
        raise RecordingError(f"{recording.path}: {count} frames are too few to measure noise; {least} are the least")
    whole = aligned_window(frames, recording.sensor, 0, 0, count)
    total = whole.count.astype(np.float64)
    used = total >= LEAST_SPIKES
    if not used.any():
        raise RecordingError(
            f"{recording.path}: no pixel has {LEAST_SPIKES} spikes in {count} frames; use a lit scene or more frames"
        )
    rate = total[used] / count
    interval, jitter = _intervals(recording.sensor, frames, used)
    rows = tuple(_windows(recording, frames, used, rate, length) for length in lengths)
    return NoiseReport(count, float(total.mean() / count), interval, jitter, rows)


def _windows(
    recording: Recording, frames: NDArray[np.uint8], used: NDArray[np.bool_], rate: NDArray[np.float64], length: int
) -> WindowNoise:
    begins = range(MARGIN, len(frames) - MARGIN - length + 1, length)
    counts, charges = np.empty((2, len(begins), len(rate)))
    for number, begin in enumerate(begins):
        low, high = begin - MARGIN, begin + length + MARGIN
        window = aligned_window(frames[low:high], recording.sensor, low, begin, begin + length)
        counts[number] = window.count[used]
        spikes = window.spikes[used].astype(np.float64)
        time = window.stop_offset[used].astype(np.float64) - window.start_offset[used]
        charges[number] = np.where(spikes > 0, spikes / np.maximum(time, 1), np.nan)
    seen = np.isfinite(charges).sum(0) >= LEAST_WINDOWS
    if not seen.any():
        raise RecordingError(f"{recording.path}: too dark to measure the charge between spikes in {length} frames")
    return WindowNoise(
        length,
        len(begins),
        float(counts.var(0, ddof=1).mean()),
        float((length * rate * (1 - rate)).mean()),
        float(np.median(counts.std(0, ddof=1) / (length * rate))),
        float(np.median(np.nanstd(charges[:, seen], 0, ddof=1) / rate[seen])),
    )


def _intervals(sensor: Sensor, frames: NDArray[np.uint8], used: NDArray[np.bool_]) -> tuple[float, float]:
    """Medians over the pixels of the mean and of the standard deviation of the frames from spike to spike."""
    last = np.full(used.shape, -1, np.int32)
    number, total, squares = np.zeros(used.shape), np.zeros(used.shape), np.zeros(used.shape)
    for frame in range(len(frames)):
        v, u = np.nonzero(unpack(frames[frame : frame + 1], sensor)[0] & used)
        before = last[v, u]
        length = np.where(before >= 0, frame - before, 0)
        number[v, u] += before >= 0
        total[v, u] += length
        squares[v, u] += length * length
        last[v, u] = frame
    enough = number >= 2
    mean = total[enough] / number[enough]
    variance = np.maximum(squares[enough] / number[enough] - mean**2, 0) * number[enough] / (number[enough] - 1)
    return float(np.median(mean)), float(np.median(np.sqrt(variance)))
