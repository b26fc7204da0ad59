"""Spike rates of the pixels over some frames, of a whole image or of a region of it."""

import base64
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from spiked.errors import ConfigurationError

__all__ = ["NotInImageError", "RateStatistics", "Region", "as_text", "from_text", "histogram_of", "statistics_of"]

_BINS = 64
"""Bins of the histogram of rates, 0 to 1 spike a frame."""
_HOT_RATE = 0.3
"""Excess rate of a hot pixel over the median of its 5x5 neighbours, spikes per frame."""
_HOT_MOST = 64
"""Hot pixels listed, the worst first."""


class NotInImageError(ConfigurationError):
    """The image has no such pixels."""


@dataclass(frozen=True)
class Region:
    """A rectangle of pixels of the upright image."""

    x: int
    y: int
    width: int | None = None
    """None: to the edge of the image."""
    height: int | None = None

    def within(self, width: int, height: int) -> tuple[slice, slice]:
        """Rows and columns in an image of this size. Raises NotInImageError for a region that is not all within it."""
        columns = slice(self.x, width if self.width is None else self.x + self.width)
        rows = slice(self.y, height if self.height is None else self.y + self.height)
        if not (0 <= columns.start < columns.stop <= width and 0 <= rows.start < rows.stop <= height):
            raise NotInImageError(
                f"columns {columns.start} to {columns.stop - 1} of rows {rows.start} to {rows.stop - 1} are not all "
                f"within the image of {width}x{height} pixels"
            )
        return rows, columns


@dataclass(frozen=True)
class RateStatistics:
    """Spike rates of the pixels."""

    frame: int
    """Absolute index of the middle one of the frames."""
    frames: int
    """Number of frames in which spikes were counted."""
    rate_histogram: list[int]
    """As of `histogram_of`."""
    hot_pixels: list[tuple[int, int]]
    """x, y of pixels that fire much more often than their neighbours, at most 64, the worst first."""
    mean_rate: float
    """Spikes per pixel and frame."""
    deviation: float
    """Standard deviation of the rates of the pixels, spikes per frame."""


def statistics_of(counts: NDArray[np.uint16], frames: int, frame: int, region: Region | None = None) -> RateStatistics:
    """Of the spikes [H, W] that were counted in `frames` frames around `frame`.

    Raises NotInImageError.
    """
    rows, columns = (region or Region(0, 0)).within(counts.shape[1], counts.shape[0])
    rate = counts.astype(np.float32) / np.float32(frames)
    inside = rate[rows, columns]
    return RateStatistics(
        frame=frame,
        frames=frames,
        rate_histogram=histogram_of(inside),
        hot_pixels=[(x, y) for x, y in _hot(rate) if rows.start <= y < rows.stop and columns.start <= x < columns.stop],
        mean_rate=float(inside.mean()),
        deviation=float(inside.std()),
    )


def histogram_of(rate: NDArray[np.float32]) -> list[int]:
    """Number of pixels by rate, in 64 equal bins from 0 to 1 spike per frame."""
    counts: list[int] = np.histogram(rate, _BINS, (0, 1))[0].tolist()
    return counts


def as_text(counts: NDArray[np.uint16]) -> str:
    """Counts [H, W] for a line of text: a PNG of 8 bits, or 16 if a pixel has more spikes, in base64."""
    small = counts.astype(np.uint8) if counts.max() < 256 else counts
    _, encoded = cv2.imencode(".png", small, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    return base64.b64encode(encoded.tobytes()).decode()


def from_text(text: str) -> NDArray[np.uint16]:
    """The counts of `as_text`."""
    counts = cv2.imdecode(np.frombuffer(base64.b64decode(text), np.uint8), cv2.IMREAD_UNCHANGED)
    assert counts is not None, "the worker writes a PNG"
    return np.asarray(counts, np.uint16)


def _hot(rate: NDArray[np.float32]) -> list[tuple[int, int]]:
    levels = (rate * 255).clip(0, 255).astype(np.uint8)
    excess = levels.astype(np.int16) - cv2.medianBlur(levels, 5)
    rows, columns = np.nonzero(excess > _HOT_RATE * 255)
    worst = np.argsort(-excess[rows, columns])[:_HOT_MOST]
    return [(int(columns[k]), int(rows[k])) for k in worst]
