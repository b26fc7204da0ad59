"""What a view keeps of its pixels: the two spikes that each one's charge lies between, in a byte each.

Rates, their noise and times follow from these when somebody asks. A tracker asks for the rates of each view once and
goes on; images of all of them would be four times as much fresh memory, whose first touch costs more than the sums.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

import spiked.native._odometry as _odometry
from spiked.blocks import Window
from spiked.pose import Array

Image = NDArray[np.float32]
Offsets = NDArray[np.unsignedinteger[Any]]

JITTER = 1.2e-3
"""Squared relative jitter of one interval between spikes."""


@dataclass(frozen=True)
class Edges:
    """As `Window`, with bytes where they suffice; its arrays [H, W] are copies. `never` is their largest number."""

    spikes: Offsets
    start: Offsets
    stop: Offsets
    """Frames of the edge spikes, from the first that was looked at."""
    frames: int
    """Number of frames looked at."""
    length: int
    """Frames of the nominal window."""
    middle: float
    """Its middle, from the first frame looked at."""

    @classmethod
    def of(cls, window: Window) -> "Edges":
        """What is to be kept of a window."""
        kind: type[np.unsignedinteger[Any]] = np.uint8 if window.frames < np.iinfo(np.uint8).max else np.uint16
        middle = 0.5 * (window.begin + window.end) - window.first_frame
        return cls(
            window.spikes.astype(kind),
            window.start_offset.astype(kind),
            window.stop_offset.astype(kind),
            window.frames,
            window.end - window.begin,
            middle,
        )

    def rate(self, out: Image | None = None) -> Image:
        """Spikes a frame; where no whole interval was seen, half of its upper bound. Written to `out` if given."""
        out = np.empty(self.spikes.shape, np.float32) if out is None else out
        _odometry.rates(self.spikes, self.start, self.stop, self.frames, out)
        return out

    def deviation(self) -> Image:
        """Standard deviation of `rate`, see `Window.variance`; its upper bound where no whole interval was seen."""
        out = np.empty(self.spikes.shape, np.float32)
        _odometry.deviations(self.spikes, self.start, self.stop, self.frames, JITTER, out)
        return out

    def times(self) -> tuple[Image, Image]:
        """Frames [H, W] from the middle of the window to the begin and to the end of each pixel's charge; the window's
        own where no whole interval was seen."""
        first, last = (np.empty(self.spikes.shape, np.float32) for _ in range(2))
        _odometry.times(self.spikes, self.start, self.stop, self.middle, self.length, first, last)
        return first, last

    def delays(self, picture: NDArray[np.uint8], at: Array) -> Array:
        """Frames [n] between the middle of the window and the times at which tracks at `at` [n, 2] were seen.

        Each pixel has its own; those with the steepest slopes in the picture [H, W] say most about where a track is.
        """
        out = np.empty(len(at))
        _odometry.delays(picture, self.spikes, self.start, self.stop, self.middle, np.ascontiguousarray(at), out)
        return out
