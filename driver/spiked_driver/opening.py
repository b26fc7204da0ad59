"""Discards old frames at the start of a camera's stream: frames that the camera kept before it was read."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from spiked.ring import Gap
from spiked_driver.framing import USB_COMPACT_BYTES, Framing
from spiked_driver.source import Chunk

OPENING_S = 0.05
"""Length of the opening, seconds: 1000 frames at 20 kHz, more than a camera is known to hold."""
_LEAST_FRAMES = 64
"""Least length of the opening in frames, for slow cameras."""


class OpeningFilter:
    """Frames and gaps of a framing without those before the last jump of the opening, which are not counted either.

    While nobody reads, the camera keeps the oldest frames and drops later ones. A stream therefore starts with old
    frames, and then its count jumps. The first frames are held back until more have come than a camera can keep. A real
    loss within the opening looks the same: the capture starts behind it.
    """

    def __init__(self, framing: Framing, rate_hz: float, on_discarded: Callable[[int, int], None]) -> None:
        """`on_discarded` gets the number of discarded frames, and the age of the last one in frames."""
        self._framing = framing
        self._on_discarded = on_discarded
        self._frames = max(_LEAST_FRAMES, round(OPENING_S * rate_hz))
        self._held: NDArray[np.uint8] | None = np.empty((self._frames, USB_COMPACT_BYTES), np.uint8)
        self._count = 0  # held frames that are not discarded
        self._received = 0  # frames of the opening, with discarded ones
        self._delivered = 0
        self._first = 0  # index of the framing of the first frame of the capture
        self._jump = 0

    def read_into(self, view: NDArray[np.uint8]) -> Chunk | Gap | None:
        """See `Framing.read_into`; index 0 is the first frame that was not discarded."""
        if self._held is not None:
            if not self._fill(self._held):
                return None
            return self._deliver(self._held, view)
        match item := self._framing.read_into(view):
            case Chunk():
                return Chunk(item.first - self._first, item.frames)
            case Gap():
                return Gap(item.first - self._first, item.count, item.cause)
        return None

    def _fill(self, held: NDArray[np.uint8]) -> bool:
        """Receive frames of the opening; true when it is complete."""
        while self._received < self._frames:
            match item := self._framing.read_into(held[self._count : self._count + self._frames - self._received]):
                case Chunk():
                    self._count += item.frames
                    self._received += item.frames
                case Gap():
                    self._count = 0
                    self._first = item.first + item.count
                    self._jump = item.count + 1
                case None:
                    return False
        return True

    def _deliver(self, held: NDArray[np.uint8], view: NDArray[np.uint8]) -> Chunk:
        if not self._delivered and self._received > self._count:
            self._on_discarded(self._received - self._count, self._jump)
        frames = min(len(view), self._count - self._delivered)
        view[:frames] = held[self._delivered : self._delivered + frames]
        chunk = Chunk(self._delivered, frames, waiting=self._count - self._delivered - frames)
        self._delivered += frames
        if self._delivered == self._count:
            self._held = None
        return chunk
