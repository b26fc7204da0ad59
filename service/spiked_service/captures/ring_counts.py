"""Counts of rings for the metrics, and what a capture counts of a ring that ran before it."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

from spiked.ring import CountedBefore, LossCause
from spiked_service.store.rows import ConsumerCounters, Counters, Recorded


@dataclass(frozen=True)
class RingCount:
    """What a ring has counted since it exists."""

    ring_id: str
    source: str
    counters: Counters
    over: bool
    """Whether the counters are final."""
    recording: Recorded | None = None
    """Of its capture, if there is one."""


@dataclass(frozen=True)
class RingSection:
    """The frames of a ring that belong to a capture which was triggered while the ring ran."""

    begin: CountedBefore
    """At the first frame of the capture."""
    stop_frame: int | None
    """The frame after its last one; None: the end of the ring."""
    attached: Mapping[str, ConsumerCounters]
    """The consumers, by name, when it was triggered."""

    def of_ring(self, counters: Counters) -> Counters:
        """The counters of the ring; the earlier frames are no loss of consumers that came for the capture."""
        consumers = (
            one if one.name in self.attached else replace(one, lost=max(0, one.lost - self.begin.block))
            for one in counters.consumers
        )
        return replace(counters, consumers=tuple(consumers))

    def of_capture(self, counters: Counters, end: CountedBefore | None) -> Counters:
        """The counters without what lies before the capture, and behind `end`, from what `of_ring` returned."""
        total = counters.lost if end is None else {str(cause): count for cause, count in end.lost.items()}
        next_frame = counters.next_frame if end is None else end.frame
        lost = {cause: count - self.begin.lost.get(LossCause(cause), 0) for cause, count in total.items()}
        return replace(
            counters,
            received=max(0, next_frame - self.begin.frame - sum(lost.values())),
            lost=lost,
            next_frame=next_frame,
            consumers=tuple(self._since(one) for one in counters.consumers),
        )

    def _since(self, one: ConsumerCounters) -> ConsumerCounters:
        before = self.attached.get(one.name)
        if before is None:
            return replace(one, frames_read=max(0, one.frames_read - (self.begin.frame - self.begin.block)))
        read, lost = one.frames_read - before.frames_read, one.lost - before.lost
        return one if read < 0 or lost < 0 else replace(one, frames_read=read, lost=lost)  # below 0: a new process
