"""Rate images of a recording at any time, and their levels on a display."""

import numpy as np
from numpy.typing import NDArray

from spiked.blocks import aligned_window
from spiked.recon.frontend.demosaic import fill_mosaic
from spiked.recon.statistics import WHITE_PERCENTILE
from spiked.recording import Recording
from spiked.sensor import Image

__all__ = ["levels", "rate_at", "white_of"]

EDGE_FRAMES = 64
"""Frames on both sides that are searched for the spikes nearest to the edges."""


def rate_at(recording: Recording, time_s: float, frames: int, first_frame: int = 0) -> Image | None:
    """Spikes a frame, float32 [H, W, C], of a spike-aligned window of so many frames around a time of the capture.

    C is 3 for a mosaic, filled. None where frames were lost or not recorded. `first_frame`: index in the capture of the
    first frame of the recording.
    """
    sensor = recording.sensor
    middle = int(np.floor(time_s * sensor.frame_rate_hz)) - first_frame
    last = recording.capture_index(recording.frames - 1) + 1
    begin = min(max(0, middle - frames // 2), max(0, last - frames))
    end = min(begin + frames, last)
    for edge in (EDGE_FRAMES, EDGE_FRAMES // 4, 0):  # fewer beside a gap
        low, high = max(0, begin - edge), min(end + edge, last)
        stored = recording.captured(low, high - low) if begin <= middle < end else None
        if stored is not None:
            window = aligned_window(np.ascontiguousarray(stored), sensor, low, begin, end)
            channels = sensor.mosaic.channels(sensor.height, sensor.width) if sensor.mosaic else None
            return fill_mosaic(window.rate(fill=True), channels)
    return None


def white_of(image: NDArray[np.float32]) -> float:
    """The value of [H, W] or [H, W, C] that is shown as white: `WHITE_PERCENTILE` of them, above 0."""
    return max(float(np.percentile(image, WHITE_PERCENTILE)), 1e-6)


def levels(image: NDArray[np.float32], white: float) -> NDArray[np.uint8]:
    """Bytes [H, W] or [H, W, C] of linear values of the same shape; `white` becomes 255."""
    return np.asarray(np.rint(255 * np.clip(np.nan_to_num(image) / max(white, 1e-9), 0, 1)), np.uint8)
