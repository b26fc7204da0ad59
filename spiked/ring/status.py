"""Status of a ring for any process: the counters of its writer and of each reader."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Self

from spiked.deprecation import renamed_attributes
from spiked.native._ring import READER_PLACES, ReaderCounters
from spiked.ring.items import DeviceState, DeviceStatus, EndReason, LossCause, Policy, decode, encode, is_clock_pair
from spiked.ring.process import is_alive, own_identity, pid_of
from spiked.ring.segment import RingLayout, Segment, attach_segment


@renamed_attributes(received="frames_read")
@dataclass(frozen=True)
class ReaderStatus:
    """Progress of one reader; `frames_read + lost == next_frame` always."""

    consumer: str
    policy: Policy
    pid: int
    alive: bool
    frames_read: int
    """Frames that it released intact."""
    lost: int
    """Frames of the gaps that it got, of any cause."""
    next_frame: int
    lag_frames: int
    """Published frames that it has not reached."""
    fill: float
    """Its lag divided by the slots that it may lag: at 1 it loses frames."""
    lagging: bool
    """It was overrun and has not reached the newest block since."""
    overruns: int


@renamed_attributes(condition="device_status")
@dataclass(frozen=True)
class WriterStatus:
    """Counters of the writer; `committed + sum(lost.values()) == next_frame` always."""

    pid: int
    alive: bool
    device_status: DeviceStatus
    committed: int
    """Frames."""
    lost: Mapping[LossCause, int]
    """Frames, by cause."""
    next_frame: int
    end: EndReason | None
    """None while the capture runs."""


@dataclass(frozen=True)
class RingStatus:
    """Snapshot of a ring."""

    name: str
    geometry: RingLayout
    writer: WriterStatus
    readers: tuple[ReaderStatus, ...]


@dataclass(frozen=True)
class CountedBefore:
    """What a ring had counted when it came to a frame."""

    frame: int
    block: int
    """First frame of the block, or of the gap, that holds the frame: a reader that starts at the frame starts here."""
    lost: Mapping[LossCause, int]
    """Frames lost before the frame, by cause."""


@dataclass(frozen=True)
class ReaderPlace:
    """A reader's record in shared memory."""

    owner: int
    consumer: str
    policy: Policy
    lease_slots: int
    counters: ReaderCounters


@renamed_attributes(hold="claim_for_successor", give_up="abandon", bury="remove_dead_readers")
class Ring:
    """A ring seen from outside, without taking frames. It stays readable after the ring's name is removed."""

    def __init__(self, segment: Segment) -> None:
        self._segment = segment

    @classmethod
    def attach(cls, name: str) -> Self:
        """The ring of that name. Raises RingError if there is none."""
        return cls(attach_segment(name))

    @property
    def name(self) -> str:
        """Name by which readers attach."""
        return self._segment.name

    @property
    def geometry(self) -> RingLayout:
        """Sensor, number of slots, and frames per slot."""
        return self._segment.geometry

    def status(self) -> RingStatus:
        """Counters of the writer and of every reader."""
        return read_status(self._segment)

    def counted_before(self, frame: int) -> CountedBefore:
        """The counters as they were at a frame; losses that the log no longer holds count as before it."""
        control = self._segment.control
        writer = control.writer()
        lost, block = {cause: writer.lost[encode(cause) - 1] for cause in LossCause}, int(writer.next_frame)
        for position in range(writer.entries - 1, -1, -1):
            entry = control.read_entry(position)
            if entry is None:
                break  # overwritten
            if is_clock_pair(entry):
                continue
            block = int(entry.first)
            if entry.cause:
                behind = block + entry.count - max(block, frame)
                lost[decode(LossCause, entry.cause)] -= max(0, behind)
            if block <= frame:
                break
        return CountedBefore(frame, block, lost)

    def claim_for_successor(self, reason: str) -> bool:
        """Take ownership of a dead writer's ring until a successor starts: readers wait, the ring is not removed.

        False if the capture has ended, so that no successor can continue it.
        """
        if self._segment.control.writer().end:
            return False
        self._segment.owner = own_identity()
        self._segment.control.publish_condition(encode(DeviceState.LOST), reason)
        return True

    def abandon(self) -> None:
        """Give up ownership without a successor: readers get the end WRITER_DIED."""
        self._segment.owner = 0
        self._segment.control.committed.ring()

    def remove_dead_readers(self, consumer: str) -> None:
        """Free the places of dead readers of this name and stop waiting for one to attach."""
        self._segment.absent_readers += 1
        for index in range(READER_PLACES):
            place = self._segment.control.place(index)
            owner = place.owner()
            if owner and not is_alive(owner) and place.label()[2].decode(errors="ignore") == consumer:
                place.claim(owner, 0)
        self._segment.control.progress.ring()


def read_places(segment: Segment) -> Iterator[ReaderPlace]:
    """The attached readers, and dead ones until another reader takes their place."""
    for index in range(READER_PLACES):
        place = segment.control.place(index)
        owner = place.owner()
        if not owner or place.described_by() != owner:
            continue
        policy, lease_slots, consumer = place.label()
        counters = place.counters()
        if place.owner() == owner:
            text = consumer.decode(errors="ignore")
            yield ReaderPlace(owner, text, decode(Policy, policy), lease_slots, counters)


def read_status(segment: Segment) -> RingStatus:
    """A snapshot. Each record is consistent; records of different processes may differ slightly in time."""
    places = list(read_places(segment))
    counters = segment.control.writer()
    code, reason = segment.control.condition()
    writer = WriterStatus(
        pid_of(segment.owner),
        is_alive(segment.owner),
        DeviceStatus(decode(DeviceState, code), reason.decode(errors="ignore")),
        counters.committed,
        {cause: counters.lost[encode(cause) - 1] for cause in LossCause},
        counters.next_frame,
        decode(EndReason, counters.end) if counters.end else None,
    )
    readers = tuple(
        ReaderStatus(
            place.consumer,
            place.policy,
            pid_of(place.owner),
            is_alive(place.owner),
            place.counters.received,
            place.counters.lost,
            place.counters.next_frame,
            counters.next_frame - place.counters.next_frame,
            min(1.0, (counters.slots - place.counters.next_slot) / place.lease_slots),
            bool(place.counters.lagging),
            place.counters.overruns,
        )
        for place in places
    )
    return RingStatus(segment.name, segment.geometry, writer, readers)
