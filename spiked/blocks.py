"""Spikes to numbers: spike-aligned windows, and frames as images of 0 and 1.

The functions take stored frames, uint8 [n, frame_bytes], of either row layout and bit order, and return upright images.
They are compiled (`native/spikes`) for each instruction set; the widest one of the machine is used.

Time: frame k covers [k, k + 1) in units of frames. A spike in frame k was fired at k + 0.5 +- 0.5, so the time between
spikes in frames k and l is l - k with the error of two independent uniform variables (variance 1/6).
"""

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

import spiked.native._spikes as _spikes
from spiked.errors import ConfigurationError
from spiked.sensor import BitOrder, Sensor

__all__ = ["Window", "aligned_window", "instruction_sets", "unpack"]


@dataclass(frozen=True)
class Window:
    """For each pixel the spikes nearest to both ends of a nominal window, and the charge between them (docs/method.md).

    The charge between the spikes in frames `start` and `stop` is exactly `spikes` thresholds, which is far less noisy
    than `count`. An edge spike may lie inside or outside the nominal window, within the frames read; of
    two at the same distance the outer one is taken. Where both edges meet in one spike, each moves outwards to its
    neighbour if there is one. All arrays are upright, [height, width].
    """

    first_frame: int
    """Absolute index of the first frame read; `start_offset` and `stop_offset` count from here."""
    frames: int
    """Number of frames read."""
    begin: int
    """Absolute index of the nominal window's first frame."""
    end: int
    """One past its last frame."""
    spikes: NDArray[np.uint16]
    """Spikes after `start` up to and including `stop`; 0 without two spikes."""
    start_offset: NDArray[np.uint16]
    """Frame of the first edge spike; where `spikes` is 0, the pixel's only spike or 65535 for none."""
    stop_offset: NDArray[np.uint16]
    """Frame of the second edge spike; as `start_offset` where `spikes` is 0."""
    count: NDArray[np.uint16]
    """Plain number of spikes in [begin, end)."""

    @cached_property
    def start(self) -> NDArray[np.int64]:
        """Absolute frame index of the first edge spike, -1 for none; it fired at start + 0.5 +- 0.5."""
        return self._absolute(self.start_offset)

    @cached_property
    def stop(self) -> NDArray[np.int64]:
        """Absolute frame index of the second edge spike, -1 for none; it fired at stop + 0.5 +- 0.5."""
        return self._absolute(self.stop_offset)

    def _absolute(self, offset: NDArray[np.uint16]) -> NDArray[np.int64]:
        return np.where(offset == 0xFFFF, -1, offset.astype(np.int64) + self.first_frame)

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Where a whole interval was found."""
        return self.spikes > 0

    def duration(self) -> NDArray[np.float32]:
        """Frames from `start` to `stop`; 0 where `spikes` is 0."""
        return (self.stop_offset - self.start_offset).astype(np.float32)

    def rate(self, *, fill: bool = False) -> NDArray[np.float32]:
        """Spikes a frame. Where no interval was found NaN or, with `fill`, half of `rate_bound`."""
        missing = 0.5 * self.rate_bound() if fill else np.full(self.spikes.shape, np.nan, np.float32)
        np.divide(self.spikes, self.duration(), out=missing, where=self.valid, dtype=np.float32)
        return missing

    def rate_bound(self) -> NDArray[np.float32]:
        """Upper bound of the mean rate where `spikes` is 0: s spikes in n frames had less than s + 1 thresholds."""
        seen = (self.start_offset != 0xFFFF).astype(np.float32)
        return np.asarray((seen + 1) / np.float32(self.frames), np.float32)

    def centre(self) -> NDArray[np.float64]:
        """Time of the middle between the edge spikes in absolute frames (frame k's middle is k + 0.5); NaN for none."""
        middle = (self.start_offset.astype(np.float64) + self.stop_offset) / 2 + (self.first_frame + 0.5)
        return np.where(self.valid, middle, np.nan)


def _layout(sensor: Sensor) -> _spikes.Layout:
    """The layout of a sensor. The last one is kept: hashing a sensor takes longer than a small window."""
    global _last_layout  # noqa: PLW0603
    known, layout = _last_layout
    if known is not sensor:
        msb = sensor.bit_order is BitOrder.MSB
        layout = _spikes.Layout(sensor.width, sensor.height, sensor.row_stride, sensor.flipped, msb)
        _last_layout = (sensor, layout)
    return layout


_last_layout: tuple[Sensor | None, _spikes.Layout] = (None, None)


def unpack(frames: NDArray[np.uint8], sensor: Sensor, *, out: NDArray[np.uint8] | None = None) -> NDArray[np.uint8]:
    """Stored frames, uint8 [n, frame_bytes], to upright images, uint8 [n, height, width] of 0 and 1.

    With `out` its first n images are written and returned. Raises ConfigurationError for arrays of another type.
    """
    if out is None:
        out = np.empty((len(frames), sensor.height, sensor.width), np.uint8)
    if frames.dtype != np.uint8 or out.dtype != np.uint8 or not out.flags.c_contiguous:
        raise ConfigurationError(
            f"frames and images are arrays of uint8, images one after the other; got {frames.dtype} and {out.dtype}"
            f"{'' if out.flags.c_contiguous else ' that is not contiguous'}"
        )
    _spikes.unpack_frames(frames, _layout(sensor), out)
    return out[: len(frames)]


def instruction_sets() -> list[str]:
    """The instruction sets this machine can run, best first; the functions below use the first."""
    return list(_spikes.instruction_sets())


def aligned_window(
    frames: NDArray[np.uint8],
    sensor: Sensor,
    first_frame: int,
    begin: int,
    end: int,
    *,
    out: Window | None = None,
    instruction_set: str = "",
) -> Window:
    """The spike-aligned window of the nominal [begin, end), both absolute, in stored frames uint8 [n, frame_bytes].

    `frames` begins with the absolute index `first_frame` and should reach beyond the nominal window by the longest
    interval of interest. With `out`, an earlier window of this sensor, its arrays are written and the result refers to
    them. Raises ValueError unless first_frame <= begin < end <= first_frame + n and n <= 65534.
    """
    if out is None:
        spikes, start, stop, count = (np.empty((sensor.height, sensor.width), np.uint16) for _ in range(4))
    else:
        spikes, start, stop, count = out.spikes, out.start_offset, out.stop_offset, out.count
    _spikes.aligned_window(
        frames,
        _layout(sensor),
        begin - first_frame,
        end - first_frame,
        spikes,
        start,
        stop,
        count,
        instruction_set=instruction_set,
    )
    return Window(first_frame, len(frames), begin, end, spikes, start, stop, count)


@dataclass(frozen=True)
class BenchmarkRow:
    """The speed of one operation on this machine."""

    name: str
    ns_per_frame: float
    memcpy_ratio: float
    """Time over the time of copying the same stored bytes."""


def benchmark(*, repeats: int = 15) -> list[BenchmarkRow]:
    """Median times of a spike-aligned window of 32 frames, with 32 frames on either side, on random frames at rate 1/4,
    for each instruction set of this machine, on one core."""
    rows = []
    for width, height in ((400, 250), (1000, 1000)):
        sensor = Sensor(width, height, 20_000.0)
        frames = _random_frames(96, sensor)
        copy = np.empty_like(frames)
        copy_ns = _median_ns(partial(np.copyto, copy, frames), repeats)
        for name in instruction_sets():
            ns = _median_ns(partial(aligned_window, frames, sensor, 0, 32, 64, instruction_set=name), repeats)
            label = f"aligned window 32+32+32 {width}x{height} {name}"
            rows.append(BenchmarkRow(label, ns / len(frames), ns / copy_ns))
    return rows


def _random_frames(count: int, sensor: Sensor) -> NDArray[np.uint8]:
    bits = np.random.default_rng(0).integers(0, 256, (2, count, sensor.frame_bytes), np.uint8)
    frames: NDArray[np.uint8] = bits[0] & bits[1]
    return frames


def _median_ns(work: Callable[[], object], repeats: int) -> float:
    times = []
    for _ in range(repeats):
        begin = time.perf_counter_ns()
        work()
        times.append(time.perf_counter_ns() - begin)
    return float(statistics.median(times))
