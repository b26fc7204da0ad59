"""Shared-memory ring between processes: one writer, several readers, blocks of compact frames and gaps.

Frame indices are absolute and never renumbered. Every reader gets each frame of the capture once, either in `Frames` or
in a `Gap`. The writer does not wait for readers and there are no locks: a reader uses the frames in place and checks
afterwards that they were not overwritten meanwhile. Processes wait by futex on shared words, so a process that is
killed blocks no other.
"""

from spiked.deprecation import renamed_classes
from spiked.ring.items import ClockPair, DeviceState, DeviceStatus, End, EndReason, Gap, LossCause, Policy, RingError
from spiked.ring.process import own_identity
from spiked.ring.reader import Frames, Item, RingReader
from spiked.ring.segment import RingLayout, clean_stale, remove_ring
from spiked.ring.status import CountedBefore, ReaderStatus, Ring, RingStatus, WriterStatus
from spiked.ring.writer import RingWriter

__all__ = [
    "ClockPair",
    "CountedBefore",
    "DeviceState",
    "DeviceStatus",
    "End",
    "EndReason",
    "Frames",
    "Gap",
    "Item",
    "LossCause",
    "Policy",
    "ReaderStatus",
    "Ring",
    "RingError",
    "RingLayout",
    "RingReader",
    "RingStatus",
    "RingWriter",
    "WriterStatus",
    "clean_stale",
    "own_identity",
    "remove_ring",
]

__getattr__ = renamed_classes(__name__, {"Cause": LossCause, "Condition": DeviceStatus, "Geometry": RingLayout})
