"""Bits to numbers: blocks of eight frames as (count, first, last), and windows that begin and end on a spike.

Both work on stored frames, uint8 [n, frame_bytes], for either row layout and bit order, and give upright images. The
work is done in C++ (`native/blocks`) with the widest instruction set the machine has.

Time: frame k covers [k, k + 1) in units of frames. A spike in frame k was fired at k + 0.5 +- 0.5, so the time between
spikes in frames k and l is l - k with the error of two independent uniform variables (variance 1/6).
"""

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

import spiked.native._blocks as _blocks
from spiked.sensor import BitOrder, Sensor

BLOCK_FRAMES = 8
"""Frames in a block."""

Offsets = NDArray[np.uint8] | NDArray[np.uint16]


@dataclass(frozen=True)
class Block:
    """A run of frames reduced to three numbers a pixel; runs that follow each other `merge` into longer ones."""

    first_frame: int
    """Absolute index of the run's first frame."""
    frames: int
    """Length of the run; 0 is the identity of `merge`."""
    count: Offsets
    """Spikes, [height, width]; uint8 for a single block, uint16 once merged."""
    first: Offsets
    """Offset of the first spike from `first_frame`, [height, width]; `never` where there is none."""
    last: Offsets
    """Offset of the last spike from `first_frame`, [height, width]; `never` where there is none."""

    @property
    def never(self) -> int:
        """The offset that means "did not fire": the largest number of the type, 255 or 65535."""
        return int(np.iinfo(self.first.dtype).max)

    @classmethod
    def empty(cls, first_frame: int, height: int, width: int) -> "Block":
        """No frames at all: the identity of `merge` for what begins or ends at `first_frame`."""
        count = np.zeros((height, width), np.uint16)
        never = np.full((height, width), 0xFFFF, np.uint16)
        return cls(first_frame, 0, count, never, never)


@dataclass(frozen=True)
class Blocks:
    """Consecutive blocks of eight frames in common arrays; the last one may be shorter."""

    first_frame: int
    frames: int
    """Frames in all blocks together."""
    count: NDArray[np.uint8]
    """Spikes, [blocks, height, width]."""
    first: NDArray[np.uint8]
    """Offset of the first spike within its block, [blocks, height, width]; 255 where there is none."""
    last: NDArray[np.uint8]
    """Offset of the last spike within its block, [blocks, height, width]; 255 where there is none."""

    def __len__(self) -> int:
        return (self.frames + BLOCK_FRAMES - 1) // BLOCK_FRAMES

    def __getitem__(self, index: int) -> Block:
        """One block, as views."""
        if not 0 <= index < len(self):
            raise IndexError(f"block {index} of {len(self)}")
        offset = index * BLOCK_FRAMES
        length = min(BLOCK_FRAMES, self.frames - offset)
        return Block(self.first_frame + offset, length, self.count[index], self.first[index], self.last[index])


@dataclass(frozen=True)
class Window:
    """For each pixel the spikes nearest to both ends of a nominal window, and the charge between them: algorithm.md 1.

    The charge between the spikes in frames `start` and `stop` is exactly `spikes` thresholds, which is far less noisy
    than `count`. An edge spike may lie inside or outside the nominal window, within the frames that were looked at; of
    two at the same distance the outer one is taken. Where both edges meet in one spike, each moves outwards to its
    neighbour if there is one. All arrays are upright, [height, width].
    """

    first_frame: int
    """Absolute index of the first frame looked at; `start_offset` and `stop_offset` count from here."""
    frames: int
    """Number of frames looked at."""
    begin: int
    """Absolute index of the nominal window's first frame."""
    end: int
    """One past its last frame."""
    spikes: NDArray[np.uint16]
    """Spikes after `start` up to and including `stop`; 0 where no two spikes were found."""
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

    def variance(self, *, jitter: float = 0.002, rate: NDArray[np.float32] | None = None) -> NDArray[np.float32]:
        """Variance of `rate()`: (p^2 / 6 + F m + (0.01 m)^2) / T^2 (algorithm.md, decision 1); NaN without an interval.

        p is the rate (`rate`, for instance from a render, else the measured one), F the squared relative jitter of one
        interval (`jitter`: 5 % gives 0.0025), m the spikes and T the frames between the edges. The terms are the clock
        at both edges, noise that adds up over intervals, and errors of scale.
        """
        p = self.rate() if rate is None else rate
        m = self.spikes.astype(np.float32)
        charge = p * p / 6 + np.float32(jitter) * m + (np.float32(0.01) * m) ** 2
        out = np.full(m.shape, np.nan, np.float32)
        np.divide(charge, self.duration() ** 2, out=out, where=self.valid)
        return out


def _layout(sensor: Sensor) -> _blocks.Layout:
    """Of the sensor last asked for, most often: a block is reduced in less time than a sensor takes to hash."""
    global _last_layout  # noqa: PLW0603
    known, layout = _last_layout
    if known is not sensor:
        msb = sensor.bit_order is BitOrder.MSB
        layout = _blocks.Layout(sensor.width, sensor.height, sensor.row_stride, sensor.flipped, msb)
        _last_layout = (sensor, layout)
    return layout


_last_layout: tuple[Sensor | None, _blocks.Layout] = (None, None)


def unpack(frames: NDArray[np.uint8], sensor: Sensor, *, out: NDArray[np.uint8] | None = None) -> NDArray[np.uint8]:
    """Stored frames, uint8 [n, frame_bytes], to upright images, uint8 [n, height, width] of 0 and 1.

    With `out` its first n images are written and returned.
    """
    if out is None:
        out = np.empty((len(frames), sensor.height, sensor.width), np.uint8)
    _blocks.unpack_frames(frames, _layout(sensor), out)
    return out[: len(frames)]


def instruction_sets() -> list[str]:
    """The instruction sets this machine can run, best first; the functions below use the first."""
    return list(_blocks.instruction_sets())


def reduce_block(frames: NDArray[np.uint8], sensor: Sensor, first_frame: int, *, instruction_set: str = "") -> Block:
    """Reduce up to eight stored frames, uint8 [n <= 8, frame_bytes]; the first has the absolute index `first_frame`."""
    if not 1 <= len(frames) <= BLOCK_FRAMES:
        raise ValueError(f"a block has 1 to {BLOCK_FRAMES} frames, not {len(frames)}")
    return reduce_blocks(frames, sensor, first_frame, instruction_set=instruction_set)[0]


def reduce_blocks(
    frames: NDArray[np.uint8], sensor: Sensor, first_frame: int, *, out: Blocks | None = None, instruction_set: str = ""
) -> Blocks:
    """Reduce stored frames, uint8 [n, frame_bytes], to blocks of eight, the last one of what is left.

    With `out` its arrays are written (they may hold more blocks than are needed) and the result refers to them.
    """
    blocks = -(-len(frames) // BLOCK_FRAMES)
    shape = (blocks, sensor.height, sensor.width)
    if out is None:
        count, first, last = (np.empty(shape, np.uint8) for _ in range(3))
    else:
        count, first, last = out.count, out.first, out.last
    _blocks.reduce_frames(frames, _layout(sensor), count, first, last, instruction_set=instruction_set)
    if out is not None and len(count) == blocks:
        return Blocks(first_frame, len(frames), count, first, last)
    return Blocks(first_frame, len(frames), count[:blocks], first[:blocks], last[:blocks])


def merge(a: Block, b: Block) -> Block:
    """The run `a` followed by `b`, with uint16 offsets. Associative; a block of no frames changes nothing.

    Raises ValueError when `b` does not begin where `a` ends: a run never spans a gap.
    """
    frames = a.frames + b.frames
    if b.first_frame != a.first_frame + a.frames:
        raise ValueError(f"frames {a.first_frame + a.frames} to {b.first_frame} lie between the blocks")
    if frames >= 0xFFFF:
        raise ValueError(f"{frames} frames are more than a run of 65534")
    return Block(
        a.first_frame,
        frames,
        np.add(a.count, b.count, dtype=np.uint16),
        np.minimum(_widened(a, a.first, 0), _widened(b, b.first, a.frames)),
        np.where(b.last == b.never, _widened(a, a.last, 0), _widened(b, b.last, a.frames)),
    )


def _widened(block: Block, offset: Offsets, shift: int) -> NDArray[np.uint16]:
    return np.where(offset == block.never, np.uint16(0xFFFF), offset + np.uint16(shift))


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
    _blocks.aligned_window(
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
    """How fast one operation is on this machine."""

    name: str
    ns_per_frame: float
    memcpy_ratio: float
    """Time over the time of copying the same stored bytes."""


def benchmark(*, repeats: int = 15) -> list[BenchmarkRow]:
    """Median times on random frames at rate 1/4, for each instruction set of this machine, on one core."""
    rows = []
    for width, height in ((400, 250), (1000, 1000)):
        sensor = Sensor(width, height, 20_000.0)
        frames = _random_frames(96, sensor)
        for name in instruction_sets():
            rows.append(_benchmark_reduce(sensor, frames[:BLOCK_FRAMES], name, repeats))
            rows.append(_benchmark_window(sensor, frames, name, repeats))
    return rows


def _benchmark_reduce(sensor: Sensor, frames: NDArray[np.uint8], name: str, repeats: int) -> BenchmarkRow:
    out = reduce_blocks(frames, sensor, 0)
    ns = _median_ns(lambda: reduce_blocks(frames, sensor, 0, out=out, instruction_set=name), repeats)
    return _row(f"one block {sensor.width}x{sensor.height} {name}", ns, frames, repeats)


def _benchmark_window(sensor: Sensor, frames: NDArray[np.uint8], name: str, repeats: int) -> BenchmarkRow:
    ns = _median_ns(lambda: aligned_window(frames, sensor, 0, 32, 64, instruction_set=name), repeats)
    return _row(f"aligned window 32+32+32 {sensor.width}x{sensor.height} {name}", ns, frames, repeats)


def _row(name: str, ns: float, frames: NDArray[np.uint8], repeats: int) -> BenchmarkRow:
    copy = np.empty_like(frames)
    return BenchmarkRow(name, ns / len(frames), ns / _median_ns(lambda: np.copyto(copy, frames), repeats))


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
