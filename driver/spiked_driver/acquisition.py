"""The loop between a source and a ring: it fills slots and publishes them, and does nothing else."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from spiked.errors import SourceError
from spiked.ring import Cause, Condition, DeviceState, End, EndReason, Gap, RingWriter
from spiked_driver.source import READ_WAIT_S, Chunk, Source


class StopEvent(Protocol):
    """What tells the loop to stop: an Event of threading or multiprocessing."""

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
) -> EndReason:
    """Open the source, move its frames and gaps into the ring until it ends, and close it.

    With `died_s`, by the monotonic clock, it goes on for a process that died then: what its source, which had indices
    of its own, did not deliver up to the first frame is a loss of the host by the clock.

    Ends after `limit_frames` frames, lost ones included, or within a moment after `stop` is set. Waits for `consumers`
    readers before it opens the source, so that they miss none. Ends the capture in the ring in every case; the writer
    stays open. Errors of the source end the capture as failed, are published as the reason of the condition, and are
    raised.
    """
    filler = _Filler(writer, limit_frames, died_s)
    try:
        # A camera sends from the moment it is open: what came while nobody is there to take it would be lost.
        reason = _wait_for_consumers(source, writer, stop, consumers)
        if reason is None:
            with _opened(source):
                reason = _pump(source, filler, stop)
                filler.flush()
        filler.publish(source.condition)
    except BaseException as error:
        filler.flush()
        filler.publish(Condition(DeviceState.LOST, f"{type(error).__name__}: {error}"))
        writer.end(EndReason.FAILED)
        raise
    writer.end(reason)
    return reason


class _Filler:
    """Packs chunks of any length into slots that end at multiples of the block's length, after a loss as before it."""

    def __init__(self, writer: RingWriter, limit_frames: int | None, died_s: float | None = None) -> None:
        self.writer = writer
        self._limit = limit_frames
        self._died_s = died_s
        self._zero = 0  # index in the capture of what the source counts from
        self._slot: NDArray[np.uint8] | None = None
        self._filled = 0
        self._published: Condition | None = None

    @property
    def next_frame(self) -> int:
        return self.writer.next_frame + self._filled

    @property
    def full(self) -> bool:
        """The slot in hand needs no other to go on, or the capture is as long as it was to be."""
        return self._limit is not None and self.next_frame >= self._limit

    @property
    def needs_slot(self) -> bool:
        return self._slot is None

    def view(self) -> NDArray[np.uint8]:
        """Where the next frames go, uint8 [at least 1, frame_bytes]."""
        if self._slot is None:
            self._slot = self.writer.acquire()
        stop = self._capacity()
        if self._limit is not None:
            stop = min(stop, self._limit - self.writer.next_frame)
        return self._slot[self._filled : stop]

    def add(self, chunk: Chunk) -> None:
        if self._died_s is not None:
            self._bridge(chunk.frames)
            if self.full:
                return
        first = self._zero + chunk.first
        if first > self.next_frame:
            raise SourceError(f"the source jumped from frame {self.next_frame} to {first} without telling of a gap")
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
            raise SourceError(f"the source told of a gap from frame {first} when {self.next_frame} was next")
        self.flush()
        left = gap.count if self._limit is None else min(gap.count, self._limit - self.next_frame)
        self.writer.gap(left, gap.cause)

    def _bridge(self, come: int) -> None:
        """Tell of what a process that died, and the time without one, have cost; `come` frames have come since.

        Whole blocks, so that what lies in the slot in hand stays in its place; at least one, as nobody knows what the
        other had in hand.
        """
        assert self._died_s is not None
        geometry = self.writer.geometry
        lost = (time.monotonic() - self._died_s) * geometry.sensor.frame_rate_hz - come
        lost = geometry.block_frames * max(1, round(lost / geometry.block_frames))
        left = lost if self._limit is None else min(lost, self._limit - self.next_frame)
        self._died_s = None
        self.writer.gap(left, Cause.USB)
        self._zero = self.next_frame

    def flush(self) -> None:
        if self._filled:
            self.writer.commit(self._filled)
            self._slot = None
            self._filled = 0

    def publish(self, condition: Condition) -> None:
        if condition != self._published:
            self.writer.publish_condition(condition)
            self._published = condition

    def _capacity(self) -> int:
        """Frames up to the next multiple of the block's length."""
        block_frames = self.writer.geometry.block_frames
        return block_frames - self.writer.next_frame % block_frames


def _wait_for_consumers(source: Source, writer: RingWriter, stop: StopEvent, consumers: int) -> EndReason | None:
    writer.publish_condition(source.condition)
    while not writer.wait_for_readers(consumers, READ_WAIT_S):
        if stop.is_set():
            return EndReason.STOPPED
    return None


def _pump(source: Source, filler: _Filler, stop: StopEvent) -> EndReason:
    while not filler.full:
        if stop.is_set():
            return EndReason.STOPPED
        if source.waits and filler.needs_slot and not filler.writer.wait_for_room(READ_WAIT_S):
            continue
        item = source.read_into(filler.view())
        filler.publish(source.condition)
        match item:
            case Chunk():
                filler.add(item)
            case Gap():
                filler.lose(item)
            case End():
                return item.reason
            case None:
                if source.condition.state is not DeviceState.STREAMING:
                    filler.flush()  # what came before the trouble may be long in being followed
    return EndReason.FINISHED


@contextmanager
def _opened(source: Source) -> Iterator[None]:
    source.open()
    try:
        yield
    finally:
        source.close()
