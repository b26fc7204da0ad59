"""The acquisition loop: reads a source into the slots of a ring and publishes them."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from spiked.errors import SourceError, SpikedError
from spiked.ring import ClockPair, DeviceState, DeviceStatus, End, EndReason, Gap, LossCause, RingWriter
from spiked_driver.frame_clock import FrameClock
from spiked_driver.source import READ_WAIT_S, Chunk, Source

_STEADY_NS = 4_000_000_000
"""Time for which a deviating frame rate must be steady, without a loss of the host, before it is reported; ns."""
_SAME_RATE = 0.003
"""Relative deviation below which a rate counts as steady."""
_UNEVEN_NS = 12_000_000_000
"""Time after which a deviating frame rate is reported that is not steady; ns."""


class StopEvent(Protocol):
    """An Event of threading or multiprocessing that stops the loop."""

    def is_set(self) -> bool:
        """Whether to stop."""
        ...


def acquire(
    source: Source,
    writer: RingWriter,
    stop: StopEvent,
    *,
    limit_frames: int | None = None,
    consumers: int = 0,
    died_s: float | None = None,
    warn: Callable[[str], None] | None = None,
) -> EndReason:
    """Open the source, move its frames and gaps into the ring until it ends, and close it.

    `died_s` is the monotonic time at which the previous acquisition process of this capture died. The frames between
    then and the first frame of this source are published as lost by the host, counted by the clock.

    Ends after `limit_frames` frames, lost ones included, or within READ_WAIT_S after `stop` is set. Waits for
    `consumers` readers before it opens the source, so that they get every frame. Ends the capture in the ring in every
    case; the writer stays open. Errors of the source end the capture as failed, are published as the reason of the
    device status, and are raised.

    Frames of a source that does not block are timed as they arrive. `warn` gets a sentence if their rate is not the
    sensor's.
    """
    packer = SlotPacker(writer, limit_frames, died_s)
    timing = None if source.can_block else _Timing(writer, warn)
    try:
        # A camera sends as soon as it is open: without readers, its first frames would be lost.
        reason = _wait_for_consumers(source, writer, stop, consumers)
        if reason is None:
            with _opened(source):
                reason = _pump(source, packer, timing, stop)
                packer.flush()
                if timing is not None:
                    timing.finish()
        packer.publish(source.device_status)
    except BaseException as error:
        packer.flush()
        text = str(error) if isinstance(error, SpikedError) else "the acquisition failed unexpectedly"
        packer.publish(DeviceStatus(DeviceState.LOST, text))
        writer.end(EndReason.FAILED)
        raise
    writer.end(reason)
    return reason


class SlotPacker:
    """Packs chunks of any length into slots that end at multiples of the block length, also after a loss."""

    def __init__(self, writer: RingWriter, limit_frames: int | None, died_s: float | None = None) -> None:
        self.writer = writer
        self._limit = limit_frames
        self._died_s = died_s
        self._zero = 0  # index in the capture of what the source counts from
        self._slot: NDArray[np.uint8] | None = None
        self._filled = 0
        self._published: DeviceStatus | None = None

    @property
    def next_frame(self) -> int:
        return self.writer.next_frame + self._filled

    @property
    def full(self) -> bool:
        """Whether the capture has reached its length limit."""
        return self._limit is not None and self.next_frame >= self._limit

    @property
    def needs_slot(self) -> bool:
        return self._slot is None

    def view(self) -> NDArray[np.uint8]:
        """Memory for the next frames, uint8 [n >= 1, frame_bytes]."""
        if self._slot is None:
            self._slot = self.writer.acquire()
        stop = self._capacity()
        if self._limit is not None:
            stop = min(stop, self._limit - self.writer.next_frame)
        return self._slot[self._filled : stop]

    def add(self, chunk: Chunk) -> None:
        if self._died_s is not None:
            self._bridge(chunk.frames + chunk.waiting)
            if self.full:
                return
        first = self._zero + chunk.first
        if first > self.next_frame:
            raise SourceError(f"the source jumped from frame {self.next_frame} to {first} without a gap")
        if first < self.next_frame:
            raise SourceError(f"the source delivered frame {first} again, {self.next_frame} was next")
        self._filled += chunk.frames
        if self._filled == self._capacity():
            self.flush()

    def lose(self, gap: Gap) -> None:
        if self._died_s is not None:
            self._bridge(gap.count)
            if self.full:
                return
        first = self._zero + gap.first
        if first != self.next_frame:
            raise SourceError(f"the source reported a gap from frame {first} when {self.next_frame} was next")
        self.flush()
        left = gap.count if self._limit is None else min(gap.count, self._limit - self.next_frame)
        self.writer.gap(left, gap.cause)

    def _bridge(self, arrived: int) -> None:
        """Publish the frames lost between the death of the previous process and now; `arrived` have come since.

        The gap is a whole number of blocks, so that the frames in the current slot keep their place. It is at least
        one block: how many frames the previous process had not published is unknown.
        """
        assert self._died_s is not None
        geometry = self.writer.geometry
        lost = (time.monotonic() - self._died_s) * geometry.sensor.frame_rate_hz - arrived
        lost = geometry.block_frames * max(1, round(lost / geometry.block_frames))
        left = lost if self._limit is None else min(lost, self._limit - self.next_frame)
        self._died_s = None
        self.writer.gap(left, LossCause.USB)
        self._zero = self.next_frame

    def flush(self) -> None:
        if self._filled:
            self.writer.commit(self._filled)
            self._slot = None
            self._filled = 0

    def publish(self, device_status: DeviceStatus) -> None:
        if device_status != self._published:
            self.writer.publish_device_status(device_status)
            self._published = device_status

    def _capacity(self) -> int:
        """Frames up to the next multiple of the block's length."""
        block_frames = self.writer.geometry.block_frames
        return block_frames - self.writer.next_frame % block_frames


class _Timing:
    """Publishes arrival times of frames and compares the measured frame rate with the stated one."""

    def __init__(self, writer: RingWriter, warn: Callable[[str], None] | None) -> None:
        self._writer = writer
        self._warn = warn
        self._stated_hz = writer.geometry.sensor.frame_rate_hz
        self._clock = FrameClock(self._stated_hz)
        self._due = False
        self._begun = False  # the beginning of the clock's line was published
        self._suspect: tuple[float, int] | None = None  # a rate that is not the stated one, and since when
        self._wrong_since_ns: int | None = None  # since when rates are not the stated one
        self._steady_ns = 0

    def arrived(self, next_frame: int, seen_ns: int) -> None:
        """All frames before `next_frame` had arrived at `seen_ns`; some may not be published yet."""
        self._steady_ns = self._steady_ns or seen_ns
        self._due |= self._clock.arrived(next_frame - 1, seen_ns)
        if self._due and self._clock.settled:
            self._publish(seen_ns)

    def disturbed(self) -> None:
        """Restart the rate check: a busy host has delayed or lost frames."""
        self._steady_ns = time.monotonic_ns()
        self._suspect = self._wrong_since_ns = None

    def interrupted(self) -> None:
        """The frame count was interrupted: publish, then start a new clock line."""
        self.finish()
        self.disturbed()
        self._clock.restart()
        self._begun = False

    def finish(self) -> None:
        """Publish the last clock pair."""
        now_ns = time.monotonic_ns()
        if self._clock.fit(now_ns):
            self._publish(now_ns)

    def _publish(self, now_ns: int) -> None:
        self._due = False
        last = self._writer.next_frame - 1
        first = self._clock.first_frame
        if first is None or last < first:
            return
        for frame in (last,) if self._begun or first == last else (first, last):
            unix_ns = self._clock.unix_ns(frame)
            assert unix_ns is not None, "a line was fitted"
            self._writer.clock_pair(ClockPair(frame, unix_ns))
        self._begun = True
        self._check_rate(now_ns)

    def _check_rate(self, now_ns: int) -> None:
        rate_hz = self._clock.wrong_rate()
        if rate_hz is None or now_ns - self._steady_ns < _STEADY_NS:
            self._suspect = self._wrong_since_ns = None
            return
        if self._suspect is None or abs(rate_hz / self._suspect[0] - 1) > _SAME_RATE:
            self._suspect = rate_hz, now_ns
        self._wrong_since_ns = self._wrong_since_ns or now_ns
        steady = now_ns - self._suspect[1] > _STEADY_NS
        if self._warn is None or not (steady or now_ns - self._wrong_since_ns > _UNEVEN_NS):
            return
        what = f"by their count and this machine's clock, not at the stated {self._stated_hz:,.0f}"
        if steady:
            advice = f"set the option rate={rate_hz:.0f}, or all times are wrong"
            told = f"frames come at {rate_hz:,.0f} a second {what}: {advice}"
        else:
            told = f"frames come unevenly, now at {rate_hz:,.0f} a second {what}: times are those of the stated rate"
        self._warn(told)
        self._warn = None


def _wait_for_consumers(source: Source, writer: RingWriter, stop: StopEvent, consumers: int) -> EndReason | None:
    writer.publish_device_status(source.device_status)
    while not writer.wait_for_readers(consumers, READ_WAIT_S):
        if stop.is_set():
            return EndReason.STOPPED
    return None


def _pump(source: Source, packer: SlotPacker, timing: _Timing | None, stop: StopEvent) -> EndReason:
    while not packer.full:
        if stop.is_set():
            return EndReason.STOPPED
        if source.can_block and packer.needs_slot and not packer.writer.wait_for_space(READ_WAIT_S):
            continue
        item = source.read_into(packer.view())
        seen_ns = time.monotonic_ns()
        packer.publish(source.device_status)
        match item:
            case Chunk():
                packer.add(item)
                if timing is not None:
                    timing.arrived(packer.next_frame, item.seen_ns or seen_ns)
            case Gap():
                if timing is not None and source.device_status.state is not DeviceState.STREAMING:
                    timing.interrupted()
                elif timing is not None and item.cause is LossCause.USB:
                    timing.disturbed()
                packer.lose(item)
            case End():
                return item.reason
            case None:
                if source.device_status.state is not DeviceState.STREAMING:
                    packer.flush()  # publish a partial slot: the next frame may be long in coming
    return EndReason.FINISHED


@contextmanager
def _opened(source: Source) -> Iterator[None]:
    source.open()
    try:
        yield
    finally:
        source.close()
