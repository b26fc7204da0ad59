"""What a map can be fitted to instead of the charge between spikes: the images of the paper (docs/paper.md).

A target of a view offers what `SpikeIntervals` does for the map: rates, their noise, and when each pixel looked.
"""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from spiked.blocks import aligned_window, unpack
from spiked.recon.frontend.exposure import Exposed
from spiked.sensor import Image, Sensor

COUNTED_FRAMES = 32
"""Frames of an accumulation image, n of the paper (docs/paper.md)."""
COUNT_VARIANCE = 0.2
"""Variance of the number of spikes in a fixed window: two independent uniform phases give 1/6, noise adds a little."""
INTERVAL_VARIANCE = 1 / 6
"""Variance of the time between two spikes, in frames squared: each is known to a frame."""
HALF_INSTANT = 0.05
"""Half of the time, in frames, for which an instant is rendered."""


class TargetKind(StrEnum):
    """What a view records for the map beside its intervals."""

    COUNTS = "counts"
    """Spikes counted in a fixed window, the accumulation image (Eq 19)."""
    ADJACENT = "adjacent"
    """The interval between two adjacent spikes (Eq 25)."""


@dataclass(frozen=True)
class SpikeCounts(Exposed):
    """Spikes of each pixel in the same window; images are upright [H, W]."""

    count: NDArray[np.uint8]
    begin: float
    """Frames from the middle of the view to the begin of the window."""
    end: float

    kind = TargetKind.COUNTS

    @property
    def nbytes(self) -> int:
        """Bytes of the array."""
        return self.count.nbytes

    def rate(self) -> Image:
        """Spikes a frame."""
        return np.asarray(self.count / np.float32(self.end - self.begin), np.float32)

    def deviation(self) -> Image:
        """Standard deviation of `rate`."""
        noise = np.sqrt(COUNT_VARIANCE) / (self.end - self.begin)
        return np.full(self.count.shape, noise, np.float32)

    def times(self) -> tuple[Image, Image]:
        """Frames [H, W] from the middle of the view to the begin and to the end of the window, all the same."""
        return tuple(np.full(self.count.shape, t, np.float32) for t in (self.begin, self.end))  # type: ignore[return-value]


@dataclass(frozen=True)
class AdjacentSpikes(Exposed):
    """The last spike of each pixel before an instant and the first one after it; images are upright [H, W]."""

    before: NDArray[np.uint8]
    """Frames from the instant back to the spike, from 1 on; 0 for none."""
    after: NDArray[np.uint8]
    """Frames from the instant on to the spike, from 1 on; 0 for none."""
    frames: int
    """Number of frames searched."""
    offset: float
    """Frames from the middle of the view to the instant."""

    kind = TargetKind.ADJACENT

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays."""
        return self.before.nbytes + self.after.nbytes

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Where both spikes were found."""
        return (self.before > 0) & (self.after > 0)

    def _duration(self) -> Image:
        """Frames from one spike to the other; they fired in the middle of their frames."""
        return self.before.astype(np.float32) + self.after.astype(np.float32) - np.float32(1)

    def _bound(self) -> Image:
        """Upper bound of the rate where not both spikes were found: s spikes in n frames are less than s + 1."""
        seen = (self.before > 0).astype(np.float32) + (self.after > 0)
        return np.asarray((seen + 1) / np.float32(self.frames), np.float32)

    def rate(self) -> Image:
        """Spikes a frame; half of its upper bound where not both spikes were found."""
        out = np.float32(0.5) * self._bound()
        np.divide(np.float32(1), self._duration(), out=out, where=self.valid)
        return out

    def deviation(self) -> Image:
        """Standard deviation of `rate`; its upper bound where not both spikes were found."""
        rate = self.rate()
        return np.asarray(np.where(self.valid, rate**2 * np.float32(np.sqrt(INTERVAL_VARIANCE)), self._bound()))

    def times(self) -> tuple[Image, Image]:
        """Frames [H, W] from the middle of the view to the middle between the spikes, as a short time: Eq 26 renders
        each pixel at that instant."""
        middle = 0.5 * (self.after.astype(np.float32) - self.before.astype(np.float32)) + np.float32(self.offset)
        middle = np.where(self.valid, middle, np.float32(self.offset))
        return middle - np.float32(HALF_INSTANT), middle + np.float32(HALF_INSTANT)


SpikeTarget = SpikeCounts | AdjacentSpikes


def record_target(
    kind: TargetKind, frames: NDArray[np.uint8], sensor: Sensor, first_frame: int, begin: int, end: int
) -> SpikeTarget:
    """The target of the view [begin, end), absolute, from stored frames uint8 [n, frame_bytes] around it.

    `frames` begins with the absolute index `first_frame`.
    """
    middle, instant = 0.5 * (begin + end), (begin + end) // 2
    if kind is TargetKind.COUNTS:
        low = max(first_frame, instant - COUNTED_FRAMES // 2)
        high = min(first_frame + len(frames), instant + COUNTED_FRAMES // 2)
        count = aligned_window(frames, sensor, first_frame, low, high).count
        return SpikeCounts(count.astype(np.uint8), low - middle, high - middle)
    at = instant - first_frame
    before, after = (
        _first_spike(unpack(np.ascontiguousarray(part), sensor)) for part in (frames[:at][::-1], frames[at:])
    )
    return AdjacentSpikes(before, after, len(frames), instant - middle)


def record_targets(
    kinds: tuple[TargetKind, ...],
    frames: NDArray[np.uint8],
    sensor: Sensor,
    first_frame: int,
    begin: int,
    end: int,
) -> tuple[SpikeTarget, ...]:
    """See `record_target`; frames are uint8 [n, frame_bytes]."""
    return tuple(record_target(kind, frames, sensor, first_frame, begin, end) for kind in kinds)


def _first_spike(images: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Number of the first of images [n, H, W] in which each pixel fired, from 1 on; 0 for none."""
    reach = min(len(images), np.iinfo(np.uint8).max)
    images = images[:reach]
    return np.where(images.any(0), images.argmax(0) + 1, 0).astype(np.uint8)
