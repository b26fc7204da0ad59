"""What any process can know of a ring: the counters of its writer and of each reader."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Self

from spiked.native._ring import READER_PLACES, ReaderCounters
from spiked.ring.items import Cause, Condition, DeviceState, EndReason, Policy, decode, encode
from spiked.ring.process import is_alive, own_identity, pid_of
from spiked.ring.segment import Geometry, Segment, attach_segment


@dataclass(frozen=True)
class ReaderStatus:
    """How far one reader is; `received + lost == next_frame` always."""

    consumer: str
    policy: Policy
    pid: int
    alive: bool
    received: int
    """Frames it took and released intact."""
    lost: int
    """Frames it was told are lost, for whatever cause."""
    next_frame: int
    lag_frames: int
    """Frames committed or lost that it has not come to."""
    fill: float
    """Its lag as a part of the slots it may lag: at 1 it loses frames."""
    lagging: bool
    """It was overrun and has not caught up since."""
    overruns: int


@dataclass(frozen=True)
class WriterStatus:
    """What the writer published; `committed + sum(lost.values()) == next_frame` always."""

    pid: int
    alive: bool
    condition: Condition
    committed: int
    """Frames."""
    lost: Mapping[Cause, int]
    """Frames, by cause."""
    next_frame: int
    end: EndReason | None
    """None while the capture runs."""


@dataclass(frozen=True)
class RingStatus:
    """A ring at one moment."""

    name: str
    geometry: Geometry
    writer: WriterStatus
    readers: tuple[ReaderStatus, ...]


@dataclass(frozen=True)
class ReaderPlace:
    """A reader's record as it lies in shared memory."""

    owner: int
    consumer: str
    policy: Policy
    lease_slots: int
    counters: ReaderCounters


class Ring:
    """A ring looked at from outside, taking no frames; it stays readable after the ring is unlinked."""

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
    def geometry(self) -> Geometry:
        """Sensor, number of slots, and frames a slot."""
        return self._segment.geometry

    def status(self) -> RingStatus:
        """Counters of the writer and of every reader."""
        return read_status(self._segment)

    def hold(self, reason: str) -> bool:
        """Hold the ring of a writer that has died for its successor: readers wait, and nobody cleans it up.

        False if there is nothing to go on with, as the capture has ended.
        """
        if self._segment.control.writer().end:
            return False
        self._segment.owner = own_identity()
        self._segment.control.publish_condition(encode(DeviceState.LOST), reason)
        return True

    def give_up(self) -> None:
        """There will be no successor: readers are told that the writer has died."""
        self._segment.owner = 0
        self._segment.control.committed.ring()

    def bury(self, consumer: str) -> None:
        """Take dead readers of that name off the list, so that no writer holds frames for a successor."""
        for index in range(READER_PLACES):
            place = self._segment.control.place(index)
            owner = place.owner()
            if owner and not is_alive(owner) and place.label()[2].decode(errors="ignore") == consumer:
                place.claim(owner, 0)
        self._segment.control.progress.ring()


def read_places(segment: Segment) -> Iterator[ReaderPlace]:
    """The readers that attached and did not detach, dead ones too until another takes their place."""
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
    """A snapshot; each record in it is whole, records of different processes may be a moment apart."""
    places = list(read_places(segment))
    counters = segment.control.writer()
    code, reason = segment.control.condition()
    writer = WriterStatus(
        pid_of(segment.owner),
        is_alive(segment.owner),
        Condition(decode(DeviceState, code), reason.decode(errors="ignore")),
        counters.committed,
        {cause: counters.lost[encode(cause) - 1] for cause in Cause},
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
