"""The protocol of a source: it writes its next frames into its caller's memory."""

import time
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from spiked.deprecation import renamed_attributes
from spiked.ring import DeviceStatus, End, Gap
from spiked.sensor import Sensor

READ_WAIT_S = 0.1
"""A source without data returns after this time, seconds, so that its reader can stop."""


@dataclass(frozen=True)
class Chunk:
    """`frames` frames from absolute index `first` were written into the view."""

    first: int
    frames: int
    seen_ns: int | None = field(default=None, compare=False)
    """Monotonic time, ns, at which they had all arrived, if that was before the source returned; else None."""
    waiting: int = field(default=0, compare=False)
    """Frames behind these that have arrived, too, and come with the next reads."""


class Source(Protocol):
    """A camera, a recording or a simulation. Acquisition is a loop that reads it into the slots of a ring.

    The frame index starts at 0 with `open` and is never renumbered: frames that are not delivered come as a `Gap`. A
    device that is lost and found again is a `Gap` and a change of `device_status`, not an error. Used by one thread.
    """

    @property
    def sensor(self) -> Sensor:
        """The sensor; frames are delivered in its compact layout."""
        ...

    @property
    def frames(self) -> int | None:
        """Number of frames that it will deliver or lose; None: no end."""
        ...

    @property
    def can_block(self) -> bool:
        """Whether reading it late loses no frame, so that it may wait for lossless consumers."""
        ...

    @property
    def device_status(self) -> DeviceStatus:
        """State of the device and its reason."""
        ...

    def open(self) -> None:
        """Start. `device_status` is then armed, or absent if there is no device yet. Raises SourceError."""
        ...

    def close(self) -> None:
        """Stop and release all resources. Closing twice is allowed."""
        ...

    def read_into(self, view: NDArray[np.uint8]) -> Chunk | Gap | End | None:
        """Write the next frames, at most n, to the start of `view`, uint8 [n, frame_bytes].

        None if nothing came within READ_WAIT_S. After the end, returns the end again. Raises SourceError if the source
        cannot continue.
        """
        ...


former_source_names = renamed_attributes(waits="can_block", condition="device_status")
"""Class decorator of sources: the names of earlier releases."""


class Pacer:
    """Releases frames at a rate times a factor, by absolute times, so that delays do not accumulate."""

    def __init__(self, rate_hz: float, factor: float) -> None:
        self._frames_a_second = rate_hz * factor
        self._start_s: float | None = None

    def remaining_s(self, frame: int, now_s: float) -> float:
        """Seconds until the frames before this index are due; 0 without a pace. The first call is time 0."""
        if not self._frames_a_second:
            return 0.0
        if self._start_s is None:
            self._start_s = now_s
        return self._start_s + frame / self._frames_a_second - now_s

    def wait_for(self, frame: int) -> bool:
        """Wait until the frames before this index are due, at most READ_WAIT_S. Returns whether they are due."""
        remaining_s = self.remaining_s(frame, time.monotonic())
        if remaining_s > 0:
            time.sleep(min(remaining_s, READ_WAIT_S))
        return remaining_s <= READ_WAIT_S
