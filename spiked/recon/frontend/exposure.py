"""When the pixels of a view gathered their charge."""

from abc import ABC, abstractmethod
from functools import cached_property

import numpy as np

from spiked.sensor import Image

EXPOSURE_PERCENTILE = 10.0
"""Percentile of exposure starts and ends that bound the rendered span: the darkest pixels gather charge for too long to
render their whole exposure in straight sub-frames (decision 6)."""


class Exposed(ABC):
    """What a view was measured from."""

    @abstractmethod
    def times(self) -> tuple[Image, Image]:
        """Frames [H, W] from the middle of the view to the begin and to the end of each pixel's charge."""

    @cached_property
    def span(self) -> tuple[float, float]:
        """Begin and end of what most pixels gathered, see `EXPOSURE_PERCENTILE`; copies of a view share it."""
        start, stop = self.times()
        return (
            float(np.percentile(start[::4, ::4], EXPOSURE_PERCENTILE)),
            float(np.percentile(stop[::4, ::4], 100 - EXPOSURE_PERCENTILE)),
        )
