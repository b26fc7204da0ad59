"""The spikes between which each pixel's charge of a view is measured, in a byte each.

Rates, their noise and times are computed on demand. The tracker needs the rates of a view once; images of all of them
would take four times the memory, and its first access costs more than the computation.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

import spiked.native._spikes as _spikes
from spiked.blocks import Window
from spiked.pose import Array
from spiked.recon.frontend.exposure import Exposed
from spiked.sensor import Image

Offsets = NDArray[np.unsignedinteger[Any]]

JITTER = 1.2e-3
"""Squared relative jitter of one interval between spikes."""


@dataclass(frozen=True)
class SpikeIntervals(Exposed):
    """As `Window`, with bytes where they suffice; its arrays [H, W] are copies. `never` is their largest number."""

    spikes: Offsets
    start: Offsets
    stop: Offsets
    """Frames of the edge spikes, from the first frame read."""
    frames: int
    """Number of frames read."""
    length: int
    """Frames of the nominal window."""
    middle: float
    """Its middle, from the first frame read."""

    @classmethod
    def of(cls, window: Window) -> "SpikeIntervals":
        """The intervals of a window."""
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

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays."""
        return self.spikes.nbytes + self.start.nbytes + self.stop.nbytes

    def rate(self) -> Image:
        """Spikes a frame; where no whole interval was seen, what is right in the mean of many windows: a map is fitted
        to that, and the bounds of `picture` would lift its dark parts."""
        return self._rate(True, np.empty(self.spikes.shape, np.float32))

    def picture(self, out: Image) -> Image:
        """`rate`, written to `out`; half of the upper bound where no whole interval was seen, which is less noisy."""
        return self._rate(False, out)

    def _rate(self, unbiased: bool, out: Image) -> Image:
        _spikes.rates(self.spikes, self.start, self.stop, self.frames, unbiased, out)
        return out

    def deviation(self) -> Image:
        """Standard deviation of `rate` (native/spikes/rates.cpp); that of one spike where no whole interval was
        seen: the same with a spike and without, or their mean would be wrong."""
        out = np.empty(self.spikes.shape, np.float32)
        _spikes.deviations(self.spikes, self.start, self.stop, self.frames, JITTER, out)
        return out

    def times(self) -> tuple[Image, Image]:
        """Frames [H, W] from the middle of the window to the begin and to the end of each pixel's charge; the window's
        own where no whole interval was seen."""
        first, last = (np.empty(self.spikes.shape, np.float32) for _ in range(2))
        _spikes.times(self.spikes, self.start, self.stop, self.middle, self.length, first, last)
        return first, last

    def delays(self, picture: NDArray[np.uint8], at: Array) -> Array:
        """Frames [n] between the middle of the window and the times at which tracks at `at` [n, 2] were seen.

        Each pixel has its own; those with the steepest slopes in the picture [H, W] say most about where a track is.
        """
        out = np.empty(len(at))
        _spikes.delays(picture, self.spikes, self.start, self.stop, self.middle, np.ascontiguousarray(at), out)
        return out
