"""What every camera source is: something that writes its next frames into memory it is given."""

import time
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from spiked.ring import Condition, End, Gap
from spiked.sensor import Sensor

READ_WAIT_S = 0.1
"""A source that has nothing to give returns after this long, so that whoever reads it can be stopped."""


@dataclass(frozen=True)
class Chunk:
    """`frames` frames, from absolute index `first`, were written into the view."""

    first: int
    frames: int


class Source(Protocol):
    """A camera, a recording or a simulation. Acquisition is a loop that reads it into the slots of a ring.

    The frame index starts at 0 with `open` and is never renumbered: what is not delivered comes as a `Gap`. Losing the
    device and finding it again is a `Gap` and a change of `condition`, not an error. Used by one thread.
    """

    @property
    def sensor(self) -> Sensor:
        """The camera; frames are delivered in its compact layout."""
        ...

    @property
    def frames(self) -> int | None:
        """How many frames it will deliver or lose, None if there is no end."""
        ...

    @property
    def waits(self) -> bool:
        """Whether reading it late loses nothing, as with a file, so that it may wait for lossless consumers."""
        ...

    @property
    def condition(self) -> Condition:
        """Where the device stands, and why."""
        ...

    def open(self) -> None:
        """Make it ready: `condition` is armed, or absent if the device is not there yet. Raises SourceError."""
        ...

    def close(self) -> None:
        """Stop and let go of everything. Closing twice is fine."""
        ...

    def read_into(self, view: NDArray[np.uint8]) -> Chunk | Gap | End | None:
        """Write the next frames into `view`, uint8 [n, frame_bytes], from its start; n or fewer.

        None if nothing came within READ_WAIT_S. After the end, the end again. Raises SourceError when the source cannot
        go on.
        """
        ...


class Pacer:
    """Releases frames at the recorded rate times a factor, by absolute times, so that delays do not add up."""

    def __init__(self, rate_hz: float, factor: float) -> None:
        self._frames_a_second = rate_hz * factor
        self._start_s: float | None = None

    def remaining_s(self, frame: int, now_s: float) -> float:
        """Time until the frames before this index are due, never positive without a pace. The first call is time 0."""
        if not self._frames_a_second:
            return 0.0
        if self._start_s is None:
            self._start_s = now_s
        return self._start_s + frame / self._frames_a_second - now_s

    def wait_for(self, frame: int) -> bool:
        """Wait until the frames before this index are due, at most READ_WAIT_S; false if they are not."""
        remaining_s = self.remaining_s(frame, time.monotonic())
        if remaining_s > 0:
            time.sleep(min(remaining_s, READ_WAIT_S))
        return remaining_s <= READ_WAIT_S
