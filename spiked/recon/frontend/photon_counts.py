"""The light of a view of a single-photon camera: how often each pixel fired.

A pixel fires in a frame with p = 1 - exp(-flux), independently of other frames, so that the number of frames in which
it fired says all that there is to know. Its flux is -ln(1 - p). With 1/2 added to both counts the estimate is unbiased
up to terms of 1/n^2 (Anscombe, "On estimating binomial response relations", Biometrika 43, 1956).
"""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from spiked.blocks import Window
from spiked.pose import Array
from spiked.recon.frontend.exposure import Exposed
from spiked.sensor import Image

DEVIATION_PX = 7
"""Side of the square whose mean count gives a pixel's standard deviation: a deviation from the pixel's own count is
small where the count happens to be small, and weights made of it darken the map (decision 27)."""


@dataclass(frozen=True)
class PhotonCounts(Exposed):
    """What `SpikeIntervals` is for spike cameras; images are upright [H, W]."""

    count: NDArray[np.unsignedinteger[Any]]
    """Frames of the window in which each pixel fired."""
    frames: int
    """Number of frames read."""
    length: int
    """Frames of the window."""
    middle: float
    """Its middle, from the first frame read."""

    @classmethod
    def of(cls, window: Window) -> "PhotonCounts":
        """Those of a window."""
        length = window.end - window.begin
        kind: type[np.unsignedinteger[Any]] = np.uint8 if length <= np.iinfo(np.uint8).max else np.uint16
        middle = 0.5 * (window.begin + window.end) - window.first_frame
        return cls(window.count.astype(kind), window.frames, length, middle)

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays."""
        return self.count.nbytes

    def rate(self) -> Image:
        """Photons a frame."""
        return self.picture(np.empty(self.count.shape, np.float32))

    def picture(self, out: Image) -> Image:
        """`rate`, written to `out`."""
        numbers = np.arange(self.length + 1)
        flux = -np.log((self.length - numbers + 0.5) / (self.length + 0.5))
        return np.take(flux.astype(np.float32), self.count, out=out)

    def deviation(self) -> Image:
        """Standard deviation of `rate`, from the mean count around each pixel."""
        count = cv2.blur(self.count.astype(np.float32), (DEVIATION_PX, DEVIATION_PX))
        fired = (count + np.float32(0.5)) / np.float32(self.length + 1)
        deviation: Image = np.sqrt(fired / ((1 - fired) * np.float32(self.length)))
        return deviation

    def times(self) -> tuple[Image, Image]:
        """Frames [H, W] from the middle of the window to its begin and to its end, the same for all pixels."""
        half = np.full(self.count.shape, 0.5 * self.length, np.float32)
        return -half, half

    def delays(self, picture: NDArray[np.uint8], at: Array) -> Array:
        """Frames [n] between the middle of the window and the times at which tracks at `at` [n, 2] were seen: none."""
        del picture
        return np.zeros(len(at))
