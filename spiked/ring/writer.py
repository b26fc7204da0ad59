"""The writing end of a ring: one process, usually the acquisition."""

import time
from collections.abc import Callable
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from spiked.deprecation import renamed_arguments, renamed_attributes
from spiked.native._ring import Entry, WriterCounters
from spiked.ring.items import ClockPair, DeviceState, DeviceStatus, EndReason, LossCause, Policy, RingError, encode
from spiked.ring.process import is_alive, own_identity
from spiked.ring.segment import MIN_SLOTS, RingLayout, Segment, attach_segment, create_segment
from spiked.ring.status import ReaderPlace, RingStatus, read_places, read_status
from spiked.sensor import Sensor

DEFAULT_BYTES = 128 << 20
"""Default size of a ring's pixels: half a second of a 400x250 camera at 20 kHz."""
MOST_BACKLOG_BYTES = 512 << 20
"""Upper bound of the size of a ring from which a pausing reader has to catch up."""
_LOOK_AGAIN_S = 0.1
"""Interval at which a waiting writer checks its readers, seconds: a killed reader wakes nobody."""


@renamed_attributes(publish_condition="publish_device_status", has_room="has_space", wait_for_room="wait_for_space")
class RingWriter:
    """Fills slots and publishes them without waiting for readers. Used by one thread.

    `acquire` gives a slot to write into and `commit` publishes it; several slots may be acquired ahead (an eighth of
    the ring), as asynchronous transfers need, and are committed in the order of acquisition.
    """

    def __init__(self, segment: Segment, takeover_grace_s: float = 0.0) -> None:
        self._segment = segment
        self._takeover_grace_s = takeover_grace_s
        self._dead_since: dict[int, float] = {}
        self._control = segment.control
        self._counters: WriterCounters = self._control.writer()
        self._reserved = int(self._counters.slots)
        self._reserved_before = int(self._control.reserved())  # a former writer may have started slots beyond
        self.publish_device_status(DeviceStatus(DeviceState.ABSENT))

    @classmethod
    @renamed_arguments(mourning_s="takeover_grace_s")
    def create(
        cls,
        sensor: Sensor,
        *,
        slots: int | None = None,
        block_frames: int = 8,
        ring_id: str | None = None,
        takeover_grace_s: float = 0.0,
        keeper: int = 0,
    ) -> Self:
        """A new ring `spiked-<ring_id>` for compact frames of that sensor; without `slots`, of about DEFAULT_BYTES.

        `wait_for_space` keeps the frames of a killed reader for `takeover_grace_s`, so that a successor can continue
        from them. While the process `keeper` lives (see `own_identity`), only that process removes the ring's name.

        Raises RingError if the name is taken, the sizes are not possible, or there is too little shared memory.
        """
        if block_frames < 1 or (slots is not None and slots < MIN_SLOTS):
            raise RingError(
                f"a ring of {slots} slots of {block_frames} frames is not possible: "
                f"at least {MIN_SLOTS} slots of at least 1 frame"
            )
        compact = sensor.compact()
        count = max(MIN_SLOTS, DEFAULT_BYTES // (block_frames * compact.frame_bytes)) if slots is None else slots
        return cls(create_segment(RingLayout(compact, count, block_frames), ring_id, keeper), takeover_grace_s)

    @classmethod
    @renamed_arguments(mourning_s="takeover_grace_s")
    def take_over(cls, name: str, *, takeover_grace_s: float = 0.0) -> Self:
        """Continue the ring of a dead writer after its last published frame. Readers stay attached.

        Raises RingError if there is no such ring, or its capture has ended.
        """
        segment = attach_segment(name)
        if segment.control.writer().end:
            raise RingError(f"the capture of ring {name} has ended: it cannot be continued")
        segment.owner = own_identity()
        return cls(segment, takeover_grace_s)

    @property
    def name(self) -> str:
        """Name by which readers attach."""
        return self._segment.name

    @property
    def geometry(self) -> RingLayout:
        """Sensor, number of slots, and frames per slot."""
        return self._segment.geometry

    @property
    def next_frame(self) -> int:
        """Absolute index of the next frame: committed and lost frames so far."""
        return int(self._counters.next_frame)

    def acquire(self) -> NDArray[np.uint8]:
        """The next slot, uint8 [block_frames, frame_bytes], to be filled and committed.

        Readers lose its former content from now on. Raises RingError if too many slots are acquired.
        """
        ahead = self._reserved - self._counters.slots
        if ahead >= max(1, self.geometry.slots // 8):
            raise RingError(f"{ahead} slots of ring {self.name} are acquired and not committed: no more than an eighth")
        number = self._reserved
        self._reserved += 1
        self._control.reserve(max(self._reserved, self._reserved_before))
        return self._segment.slot(number, self.geometry.block_frames)

    def commit(self, frames: int) -> None:
        """Publish the first `frames` frames of the slot acquired longest ago as the next frames of the capture."""
        self._check_open()
        if self._counters.slots == self._reserved:
            raise RingError(f"no slot of ring {self.name} is acquired")
        if not 1 <= frames <= self.geometry.block_frames:
            raise RingError(f"a slot of {self.geometry.block_frames} frames cannot be committed with {frames}")
        self._append(Entry(self.next_frame, frames, 0, self._counters.slots))
        self._counters.slots += 1
        self._counters.committed += frames
        self._advance(frames)

    def gap(self, count: int, cause: LossCause) -> None:
        """Publish that the next `count` frames of the capture are lost."""
        self._check_open()
        if count <= 0:
            raise RingError(f"a gap of {count} frames is not possible")
        self._append(Entry(self.next_frame, count, encode(cause), self._counters.slots))
        self._counters.add_lost(encode(cause) - 1, count)
        self._advance(count)

    def clock_pair(self, pair: ClockPair) -> None:
        """Publish the host time at which a frame had arrived; the frame must be published already."""
        self._check_open()
        age = self.next_frame - pair.frame
        if age <= 0:
            raise RingError(f"frame {pair.frame} is not published yet: {self.next_frame} is next")
        self._append(Entry(self.next_frame, pair.unix_ns, -age, self._counters.slots))
        self._publish()

    def publish_device_status(self, device_status: DeviceStatus) -> None:
        """Publish the status of the device to all processes."""
        self._control.publish_condition(encode(device_status.state), device_status.reason)

    def has_space(self) -> bool:
        """Whether another slot can be acquired without any lossless or priority reader losing frames."""
        return not any(
            self._holds_back(reader) and (is_alive(reader.owner) or self._in_takeover_grace(reader.owner))
            for reader in read_places(self._segment)
        )

    def wait_for_space(self, timeout_s: float) -> bool:
        """Wait for `has_space`. For sources that can block, as recordings; a camera cannot."""
        return self._wait(self.has_space, timeout_s)

    def wait_for_readers(self, count: int, timeout_s: float) -> bool:
        """Wait until `count` readers are attached or given up, so that they get the capture from its first frame."""

        def attached() -> int:
            return sum(is_alive(reader.owner) for reader in read_places(self._segment))

        return self._wait(lambda: attached() + self._segment.absent_readers >= count, timeout_s)

    def status(self) -> RingStatus:
        """Counters of the writer and of every reader."""
        return read_status(self._segment)

    def end(self, reason: EndReason) -> None:
        """Publish the end of the capture; readers get it after the last frame. A second call has no effect."""
        if not self._counters.end:
            self._counters.end = encode(reason)
            self._publish()

    def close(self, reason: EndReason = EndReason.STOPPED) -> None:
        """End the capture if it has not ended; attached readers can still read up to the end.

        Removes the ring's name, unless another process keeps it for readers that attach later.
        """
        self.end(reason)
        if not is_alive(self._segment.keeper):
            self._segment.unlink()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close(EndReason.STOPPED if kind is None else EndReason.FAILED)

    def _holds_back(self, reader: ReaderPlace) -> bool:
        counters = reader.counters
        # Half the ring: a killed reader may have released slots that it had not processed (about an eighth), and its
        # successor must find them within the lease.
        allowed = min(reader.lease_slots, self.geometry.slots // 2)
        return reader.policy is not Policy.LATEST and (
            self._reserved - counters.next_slot >= allowed
            or self._counters.entries - counters.next_entry >= self.geometry.log_places // 2
        )

    def _in_takeover_grace(self, owner: int) -> bool:
        now_s = time.monotonic()
        return self._takeover_grace_s > 0 and now_s - self._dead_since.setdefault(owner, now_s) < self._takeover_grace_s

    def _append(self, entry: Entry) -> None:
        self._control.write_entry(self._counters.entries, entry)
        self._counters.entries += 1

    def _advance(self, frames: int) -> None:
        self._counters.next_frame += frames
        self._publish()

    def _publish(self) -> None:
        """Publish all counters at once and wake readers: a kill before or after leaves a consistent ring."""
        self._control.publish(self._counters)
        self._control.committed.ring()

    def _check_open(self) -> None:
        if self._counters.end:
            raise RingError(f"the capture of ring {self.name} has ended")

    def _wait(self, condition: Callable[[], bool], timeout_s: float) -> bool:
        """Wait for progress of readers until the condition holds."""
        deadline = time.monotonic() + timeout_s
        while True:
            seen = self._control.progress.value()
            if condition():
                return True
            remaining_s = deadline - time.monotonic()
            if remaining_s <= 0:
                return False
            self._control.progress.wait(seen, min(remaining_s, _LOOK_AGAIN_S))
