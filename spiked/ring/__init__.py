"""Shared-memory ring between processes: one writer, several readers, blocks of compact frames and gaps.

Frame indices are absolute and never renumbered; every reader gets each frame of the capture once, either in `Frames` or
in a `Gap`. The writer waits for nobody and nobody holds a lock: readers look at the frames in place and ask afterwards
whether they were overwritten meanwhile. They wait by futex on shared words, which keep nothing of a process that dies.
"""

from spiked.ring.items import Cause, Condition, DeviceState, End, EndReason, Gap, Policy, RingError
from spiked.ring.reader import Frames, Item, RingReader
from spiked.ring.segment import Geometry, clean_stale
from spiked.ring.status import ReaderStatus, Ring, RingStatus, WriterStatus
from spiked.ring.writer import RingWriter

__all__ = [
    "Cause",
    "Condition",
    "DeviceState",
    "End",
    "EndReason",
    "Frames",
    "Gap",
    "Geometry",
    "Item",
    "Policy",
    "ReaderStatus",
    "Ring",
    "RingError",
    "RingReader",
    "RingStatus",
    "RingWriter",
    "WriterStatus",
    "clean_stale",
]
