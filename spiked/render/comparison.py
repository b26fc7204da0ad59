"""How a GPU compares an image with a view that lies there, too: what it is told, and the numbers that come back."""

from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Any

from spiked.render.splats import Floats

MOST_FRAME_BYTES = 1 << 30
"""Views that a map keeps on a GPU: 640 of 400x250, 64 of 1000x1000."""


@dataclass(frozen=True)
class DeviceFrame:
    """A view on a GPU: rates, their deviations, and when each pixel looked; made by `GpuRasteriser.frame`."""

    native: Any
    nbytes: int
    """Bytes on the device."""


@dataclass(frozen=True)
class RateTerms:
    """The terms of a loss of rates: squared errors weighted by their noise, and structural similarity."""

    white: float
    """The rate that counts as full scale."""
    floor: float
    """Noise added to each pixel, in units of white."""
    ssim: float
    """Share of structural similarity, 0 to 1."""
    ssim_scale: float
    """Factor on 1 - SSIM."""


@dataclass(frozen=True)
class ViewGains:
    """By what a view is brighter than the map: `gain * level`. The pixels that agree with `gain` tell the level."""

    gain: Floats
    """Of the pixels, [H, W]; copied to the device when it is another array than before."""
    level: float
    """Of the whole view."""
    model_error: float
    """Relative error of the render, added to the deviation of each pixel."""
    sigmas: float
    """Deviations within which a pixel agrees."""


@dataclass(frozen=True)
class Compared:
    """An image compared with a view."""

    error: float
    """Mean squared error, weighted by the noise, in units of white squared."""
    unlike: float
    """1 - SSIM; 0 where its share is 0."""
    expected_light: float
    """Gain times image, summed over the pixels that agree; 0 without gains."""
    seen_light: float
    """The view's rates, likewise."""


class FrameCache:
    """Views on a GPU by their keys: those used last, as many as fit."""

    def __init__(self, most_bytes: int = MOST_FRAME_BYTES) -> None:
        self._most_bytes = most_bytes
        self._frames: OrderedDict[Hashable, DeviceFrame] = OrderedDict()

    def __getstate__(self) -> dict[str, object]:
        """Without the views: they are made anew when they are asked for."""
        return vars(self) | {"_frames": OrderedDict()}

    def __len__(self) -> int:
        return len(self._frames)

    @property
    def nbytes(self) -> int:
        """Bytes that are held."""
        return sum(frame.nbytes for frame in self._frames.values())

    def get(self, key: Hashable, make: Callable[[], DeviceFrame]) -> DeviceFrame:
        """The view of a key, which is made if it is not there; the last one stays whatever its size."""
        if key in self._frames:
            self._frames.move_to_end(key)
            return self._frames[key]
        made = self._frames[key] = make()
        while len(self) > 1 and self.nbytes > self._most_bytes:
            self._frames.popitem(last=False)
        return made
