"""The reading end of a ring: one consumer in one process."""

import time
from bisect import bisect_left, bisect_right
from collections import deque
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from spiked.native._ring import READER_PLACES, Control, Entry, ReaderCounters, ReaderPlace, WriterCounters
from spiked.ring.items import (
    ClockPair,
    End,
    EndReason,
    Gap,
    LossCause,
    Policy,
    RingError,
    decode,
    encode,
    is_clock_pair,
)
from spiked.ring.process import is_alive, own_identity
from spiked.ring.segment import RingLayout, Segment, attach_segment
from spiked.ring.status import RingStatus, read_status

_CLOCK_PAIRS = 1024
"""Clock pairs kept for `clock_pairs`; older ones are dropped."""
_LOOK_AGAIN_S = 0.1
"""Interval at which a waiting reader checks that the writer lives, seconds: a killed writer wakes nobody."""
_TAKEOVER_GRACE_S = 0.5
"""Time for a restarted writer to take over, seconds."""


class Frames:
    """Frames `first` to `first + count - 1`, in place in the ring: `data`, uint8 [count, frame_bytes].

    The writer does not wait: results computed from `data` are valid only if `release` returns true afterwards. As a
    context manager it yields `data` and releases at the end; call `valid` then.
    """

    def __init__(self, reader: "RingReader", first: int, data: NDArray[np.uint8], slot: int) -> None:
        self._reader = reader
        self._slot = slot
        self._intact: bool | None = None
        self.first = first
        self.count = len(data)
        self.data = data
        """Compact frames, uint8 [count, frame_bytes], read-only."""

    def valid(self) -> bool:
        """Whether the frames have not been overwritten up to now, or up to their release."""
        return self._reader._holds(self._slot) if self._intact is None else self._intact

    def present(self) -> bool:
        """Whether the ring still has the frames, also after their release."""
        return self._reader._holds(self._slot)

    def release(self) -> bool:
        """Return the slot. True if the frames were intact until now; they then count as read.

        Otherwise they count as lost and the next item is their gap. Taking the next item releases, too.
        """
        if self._intact is None:
            self._intact = self._reader._check_released(self)
        return self._intact

    def __enter__(self) -> NDArray[np.uint8]:
        return self.data

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.release()


Item = Frames | Gap | End


class RingReader:
    """Returns frames, gaps and the end in order. Every frame of the capture comes once, in `Frames` or in a `Gap`.

    Earlier frames that the ring no longer holds when the reader attaches come as a gap, too. Used by one thread.
    """

    def __init__(self, segment: Segment, policy: Policy, consumer: str | None, start_frame: int | None = None) -> None:
        """See `attach`, and without a `consumer` `watch`."""
        self._segment = segment
        self._control: Control = segment.control
        self._policy = policy
        self._lease_slots = _lease(policy, segment.geometry.slots)
        self._counters = ReaderCounters()
        self._jumped = False  # a gap up to this entry was returned: take it even if it is late again
        self._held: Frames | None = None
        self._clock_pairs: deque[ClockPair] = deque(maxlen=_CLOCK_PAIRS)
        self._end: End | None = None
        self._orphaned_s: float | None = None
        self._look_s = 0.0
        writer = self._control.writer()
        self._counters.next_entry = (
            self._position_to_take(writer) if start_frame is None else self._position_of(start_frame, writer)
        )
        self._counters.next_slot = self._slot_of(self._counters.next_entry, writer)
        self._start = self._counters.next_entry  # earlier frames were missed by attaching late and are no overrun
        self._owner = own_identity()
        self._looks_on = consumer is None
        self._place = None if consumer is None else self._claim_place(consumer)

    @classmethod
    def attach(cls, name: str, policy: Policy, consumer: str, start_frame: int | None = None) -> Self:
        """Read the ring of that name; `consumer` is shown in the ring's status.

        Starts at the block that holds `start_frame`, if the ring still has it and the policy allows that lag. Without
        `start_frame`, starts half the allowed lag behind the newest block. Raises RingError if there is no such ring or
        no place for another reader.
        """
        return cls(attach_segment(name), policy, consumer, start_frame)

    @classmethod
    def watch(cls, name: str) -> Self:
        """Look on: read without a place among the readers, from the newest block on.

        The writer does not know of it, and the memory is read-only here: a reader that sleeps, is killed or goes wrong
        changes nothing for the capture. It may lag half of the ring, as with Policy.LOSSLESS, but a source that waits
        for its readers does not wait for it. Frames before its first block are no gap. Raises RingError if there is no
        such ring, or it belongs to another user.
        """
        segment = attach_segment(name, writable=False)
        newest = segment.control.writer().next_frame - 1
        reader = cls(segment, Policy.LOSSLESS, None, newest)
        reader._begin_at_start(newest)
        return reader

    def another(self, policy: Policy, consumer: str, start_frame: int) -> "RingReader":
        """One more reader of the same ring, whose name may have been removed meanwhile; see `attach`.

        Raises RingError if this one only looks on: its memory is read-only.
        """
        if self._looks_on:
            raise RingError(f"an onlooker of ring {self._segment.name} cannot make a reader with a place: attach to it")
        return RingReader(self._segment, policy, consumer, start_frame)

    @property
    def backlog_frames(self) -> int:
        """Frames that it may lag behind the newest before others are skipped, or of a lossless one lent."""
        return self._lease_slots * self.geometry.block_frames

    @property
    def geometry(self) -> RingLayout:
        """Sensor, number of slots, and frames per slot."""
        return self._segment.geometry

    @property
    def newest_frame(self) -> int:
        """One past the last published frame, lost ones included; cheaper than `status`."""
        return int(self._control.writer().next_frame)

    @property
    def overruns(self) -> int:
        """Number of times that it fell behind and lost published frames."""
        return int(self._counters.overruns)

    def clock_pairs(self) -> list[ClockPair]:
        """Clock pairs that came between the items so far, each once; at most the newest 1,024."""
        pairs = list(self._clock_pairs)
        self._clock_pairs.clear()
        return pairs

    def next(self, timeout_s: float) -> Item | None:
        """The next item; None after the timeout. After the end, returns the end again.

        If the writer dies, the capture ends with EndReason.WRITER_DIED, after all published items and half a second in
        which another process may claim the ring for a successor.
        """
        if self._held is not None:
            self._held.release()
        deadline = time.monotonic() + timeout_s
        while True:
            seen = self._control.committed.value()
            item = self._take()
            if item is not None:
                return item
            remaining_s = deadline - time.monotonic()
            if self._control.committed.wait(seen, min(max(remaining_s, 0.0), _LOOK_AGAIN_S)):
                continue
            if self._has_died():
                return self._take() or self._finish(self._control.writer(), EndReason.WRITER_DIED)
            if remaining_s <= 0:
                return None

    def _has_died(self) -> bool:
        """Whether the writer is dead and has no successor. Checked every 0.1 s: a check costs as much as a block."""
        now_s = time.monotonic()
        if now_s < self._look_s:
            return False
        self._look_s = now_s + _LOOK_AGAIN_S
        owner = self._segment.owner
        if is_alive(owner):
            self._orphaned_s = None
            return False
        self._orphaned_s = self._orphaned_s or now_s
        return not owner or now_s - self._orphaned_s > _TAKEOVER_GRACE_S

    def status(self) -> RingStatus:
        """Counters of the writer and of every reader."""
        return read_status(self._segment)

    def close(self) -> None:
        """Release the frames held and detach; the reader's counters leave the ring's status."""
        if self._held is not None:
            self._held.release()
        if self._place is not None:
            self._place.claim(self._owner, 0)
            self._control.progress.ring()
            self._place = None  # another reader may have it now

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def _begin_at_start(self, newest_frame: int) -> None:
        """Count from the entry that comes next, and keep the newest clock pair before it."""
        start, writer = self._counters.next_entry, self._control.writer()
        entry = self._control.read_entry(start)
        if entry is not None:
            self._counters.next_frame = entry.first
        else:  # not there yet, or overwritten meanwhile: what came since is lost
            self._counters.next_frame = writer.next_frame if start >= writer.entries else max(0, newest_frame)
        for position in range(start - 1, -1, -1):
            entry = self._control.read_entry(position)
            if entry is None:
                return  # overwritten
            if is_clock_pair(entry):
                self._clock_pairs.append(ClockPair(entry.first + entry.cause, entry.count))
                return

    def _take(self) -> Item | None:
        if self._end is not None:
            return self._end
        while True:
            writer = self._control.writer()
            position = self._counters.next_entry if self._jumped else self._position_to_take(writer)
            if position >= writer.entries:
                return self._finish(writer, decode(EndReason, writer.end)) if writer.end else None
            entry = self._control.read_entry(position)
            if entry is None or (entry.cause == 0 and not self._holds(entry.slot)):
                self._jumped = False
                continue  # overwritten meanwhile: choose a newer one
            if is_clock_pair(entry):
                self._counters.next_entry = position + 1
                self._start += position == self._start
                self._clock_pairs.append(ClockPair(entry.first + entry.cause, entry.count))
                continue
            if entry.first > self._counters.next_frame:
                return self._jump(position, entry)
            return self._accept(position, entry, newest=position + 1 == writer.entries)

    def _accept(self, position: int, entry: Entry, *, newest: bool) -> Item:
        self._jumped = False
        if newest:
            self._counters.lagging = 0
        self._counters.next_entry = position + 1
        if entry.cause:
            return self._lose(entry.count, decode(LossCause, entry.cause))
        data = self._segment.slot(entry.slot, entry.count)
        data.flags.writeable = False
        self._held = Frames(self, entry.first, data, entry.slot)
        return self._held

    def _jump(self, position: int, entry: Entry) -> Gap:
        """The gap between the last item and this entry, which is returned next."""
        self._jumped = True
        self._counters.next_entry = position
        self._counters.next_slot = entry.slot
        if self._policy is not Policy.LATEST and position != self._start:
            self._counters.lagging = 1
            self._counters.overruns += 1
        return self._lose(entry.first - self._counters.next_frame, LossCause.RING)

    def _finish(self, writer: WriterCounters, reason: EndReason) -> Gap | End:
        missing = writer.next_frame - self._counters.next_frame
        if missing:
            return self._lose(missing, LossCause.RING)
        self._end = End(writer.next_frame, reason)
        return self._end

    def _lose(self, count: int, cause: LossCause) -> Gap:
        gap = Gap(self._counters.next_frame, count, cause)
        self._counters.lost += count
        self._counters.next_frame += count
        self._publish()
        return gap

    def _check_released(self, frames: Frames) -> bool:
        self._held = None
        intact = self._holds(frames._slot)
        if intact:
            self._counters.received += frames.count
            self._counters.next_frame += frames.count
        self._counters.next_slot = frames._slot + 1
        self._publish()
        return intact

    def _holds(self, slot: int) -> bool:
        """Whether the ring still holds this slot. Call it after reading the slot."""
        return bool(self._control.reserved() <= slot + self.geometry.slots)

    def _position_to_take(self, writer: WriterCounters) -> int:
        """The next position in the log, or a later one if the policy skips."""
        position: int = self._counters.next_entry
        if position >= writer.entries:
            return position
        if self._policy is Policy.LATEST:
            return self._newest(position, writer)
        if writer.slots - self._slot_of(position, writer) <= self._lease_slots:
            return position
        # Half a lease behind the newest block, so that the next block does not overrun it again.
        oldest = max(position, writer.entries - self.geometry.log_places // 2)
        target_slot = writer.slots - max(1, self._lease_slots // 2)
        candidates = range(oldest, writer.entries)
        index = bisect_left(candidates, target_slot, key=lambda p: self._slot_of(p, writer))
        return candidates[min(index, len(candidates) - 1)]

    def _newest(self, position: int, writer: WriterCounters) -> int:
        """The last entry from a position on that is no clock pair; if all are, the position."""
        for newest in range(writer.entries - 1, position, -1):
            entry = self._control.read_entry(newest)
            if entry is None or not is_clock_pair(entry):
                return newest
        return position

    def _position_of(self, frame: int, writer: WriterCounters) -> int:
        """Position of the newest entry that starts at or before a frame, or of the oldest that the ring still holds."""
        candidates = range(max(0, writer.entries - self.geometry.log_places // 2), writer.entries)

        def first(position: int) -> int:
            entry = self._control.read_entry(position)
            return -1 if entry is None else int(entry.first)

        position = max(candidates.start, candidates.start + bisect_right(candidates, frame, key=first) - 1)
        while position < writer.entries and not self._has(position):
            position += 1
        return position

    def _has(self, position: int) -> bool:
        entry = self._control.read_entry(position)
        return entry is not None and (entry.cause != 0 or self._holds(entry.slot))

    def _slot_of(self, position: int, writer: WriterCounters) -> int:
        """Number of the slot at or after this entry; if it is overwritten, a number older than any lease."""
        if position >= writer.entries:
            return int(writer.slots)
        entry = self._control.read_entry(position)
        return -1 - self.geometry.slots if entry is None else int(entry.slot)

    def _claim_place(self, consumer: str) -> ReaderPlace:
        for index in range(READER_PLACES):
            place = self._control.place(index)
            owner = place.owner()
            if (owner and is_alive(owner)) or not place.claim(owner, self._owner):
                continue
            place.publish(self._counters)
            place.describe(encode(self._policy), self._lease_slots, consumer)
            self._control.progress.ring()
            return place
        raise RingError(f"ring {self._segment.name} has {READER_PLACES} readers, which is the limit: end one of them")

    def _publish(self) -> None:
        if self._place is not None:
            self._place.publish(self._counters)
            self._control.progress.ring()


def _lease(policy: Policy, slots: int) -> int:
    """Slots that a reader may lag. The rest of the ring is the time for which a returned view stays intact."""
    return slots - slots // 8 if policy is Policy.PRIORITY else slots // 2
