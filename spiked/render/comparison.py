"""How a GPU compares an image with a view that lies there, too: what it is told, and the numbers that come back."""

from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from spiked.errors import ConfigurationError
from spiked.render.charge import JITTER
from spiked.render.splats import Floats

MOST_FRAME_BYTES = 1 << 30
"""Views of a kind that a map keeps on a GPU: 671 of 400x250, 67 of 1000x1000 that see slow motion. The buffers are a
quarter larger."""


@dataclass(frozen=True)
class DeviceFrame:
    """A view on a GPU: rates, their deviations, and when each pixel looked; made by `GpuRasteriser.frame`."""

    native: Any
    nbytes: int
    """Bytes on the device."""


@dataclass(frozen=True)
class DeviceSpikes:
    """Frames of spikes on a GPU; made by `GpuRasteriser.spikes`."""

    native: Any
    nbytes: int
    """Bytes on the device."""


@dataclass(frozen=True)
class DeviceLight:
    """Gains and dark rates of a sensor's pixels on a GPU; made by `GpuRasteriser.light`."""

    native: Any


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


@dataclass(frozen=True)
class ChargeTerms:
    """The terms of a charge loss, see `ChargeLoss` and `WarpedChargeLoss`."""

    pixel: int
    """Side of the image's pixels in those of the sensor; then of so many pairs of the sensor's rows one is used."""
    phase: int
    """Number of that pair."""
    level: float
    """Brightness of the view, times the gains."""
    floor: float
    """Noise added to each pixel, spikes a frame."""
    white: float
    """The rate that counts as full scale: slopes are divided by its square."""
    nearest: float
    """Smallest depth; nearer ones are clipped."""
    detail: float
    """Gain of the slope's detail finer than `detail_px`; 0: it stays as it is."""
    detail_px: float
    """Standard deviation of a blur, in pixels of the image: 1.5 at most."""
    jitter: float = JITTER
    """Of an interval's charge."""


@dataclass(frozen=True)
class ChargeCompared:
    """An image compared with spikes, as `Charge`; its slope stays on the device."""

    loss: float
    chi2: float
    brightness: float


Kept = TypeVar("Kept", DeviceFrame, DeviceSpikes)


class FrameCache(Generic[Kept]):
    """Views on a GPU by their keys: those used last, as many as fit."""

    def __init__(self, most_bytes: int = MOST_FRAME_BYTES) -> None:
        self._most_bytes = most_bytes
        self._frames: OrderedDict[Hashable, Kept] = OrderedDict()

    def __len__(self) -> int:
        return len(self._frames)

    @property
    def nbytes(self) -> int:
        """Bytes that are held."""
        return sum(frame.nbytes for frame in self._frames.values())

    def get(self, key: Hashable, make: Callable[[], Kept]) -> Kept:
        """The view of a key, which is made if it is not there; the last one stays whatever its size.

        Where the device refuses, as it lacks memory, the others make room for it.
        """
        if key in self._frames:
            self._frames.move_to_end(key)
            return self._frames[key]
        try:
            made = make()
        except ConfigurationError:
            if not self._frames:
                raise
            self._frames.clear()
            made = make()
        self._frames[key] = made
        while len(self) > 1 and self.nbytes > self._most_bytes:
            self._frames.popitem(last=False)
        return made
