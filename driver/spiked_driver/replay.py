"""A recording played as if it were the camera."""

from bisect import bisect_right
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from spiked.errors import SourceError
from spiked.recording import Recording
from spiked.ring import Cause, Condition, DeviceState, End, EndReason, Gap
from spiked.sensor import BitOrder, Sensor
from spiked_driver.source import Chunk, Pacer


class ReplaySource:
    """Frames `first` to `stop - 1` of a recording, `repeat` times; the index starts at 0 and runs on over repeats.

    Frames that the recording lost are lost again, with their cause; `first` and `stop` count the frames it has.
    `pace` is a factor of the recorded rate; with 0 frames come as fast as lossless consumers take them.
    """

    def __init__(
        self,
        recording: Recording,
        *,
        pace: float = 1.0,
        repeat: int = 1,
        first: int = 0,
        stop: int | None = None,
    ) -> None:
        last = recording.frames if stop is None else stop
        if not 0 <= first < last <= recording.frames:
            raise SourceError(f"range {first}:{last} is not within the {recording.frames} frames of {recording.path}")
        if pace < 0 or repeat < 1:
            raise SourceError(f"a replay at pace {pace:g}, {repeat} times, is not possible")
        self._recording = recording
        self._pieces = _pieces(recording, first, last)
        self._length = sum(piece.count for piece in self._pieces)
        self._repeat = repeat
        self._pace = pace
        self._pacer = Pacer(self.sensor.frame_rate_hz, pace)
        self._next = 0
        self._condition = Condition(DeviceState.IDLE)

    @property
    def path(self) -> Path:
        """The recording's file."""
        return self._recording.path

    @property
    def sensor(self) -> Sensor:
        """The camera of the recording, with compact frames, leftmost pixel in the lowest bit."""
        return replace(self._recording.sensor.compact(), bit_order=BitOrder.LSB)

    @property
    def frames(self) -> int:
        """All repeats together, lost frames included."""
        return self._length * self._repeat

    @property
    def waits(self) -> bool:
        """Only without a pace: a paced replay behaves like the camera, which never waits."""
        return self._pace == 0

    @property
    def condition(self) -> Condition:
        """Armed once open, streaming from the first frame, idle after the last."""
        return self._condition

    def open(self) -> None:
        """Start again at frame 0."""
        self._next = 0
        self._pacer = Pacer(self.sensor.frame_rate_hz, self._pace)
        self._condition = Condition(DeviceState.ARMED)

    def close(self) -> None:
        """Leaves the recording open: it is its owner's."""
        self._condition = Condition(DeviceState.IDLE)

    def read_into(self, view: NDArray[np.uint8]) -> Chunk | Gap | End | None:
        """See `Source.read_into`; a chunk ends where a repeat or the recording's next gap begins."""
        if self._next == self.frames:
            self._condition = Condition(DeviceState.IDLE, "the recording is at its end")
            return End(self.frames, EndReason.FINISHED)
        position = self._next % self._length
        piece = self._pieces[bisect_right(self._pieces, position, key=lambda piece: piece.start) - 1]
        skip = position - piece.start
        count = piece.count if piece.cause else min(len(view), piece.count - skip)
        if not self._pacer.wait_for(self._next + count):
            return None
        first = self._next
        self._next += count
        self._condition = Condition(DeviceState.STREAMING)
        if piece.cause:
            return Gap(first, count, piece.cause)
        view[:count] = self._recording.compact(piece.stored + skip, count)
        return Chunk(first, count)


@dataclass(frozen=True)
class _Piece:
    """Frames of the capture that lie together in the file, or were lost together."""

    start: int
    """Index of the first, counted from the range's first frame."""
    count: int
    stored: int
    """Which frame of the file the first one is, or would be."""
    cause: Cause | None = None
    """Why they were lost, None if they were not."""


def _pieces(recording: Recording, first: int, stop: int) -> list[_Piece]:
    """The range in order; gaps at its ends belong to it only where they are at the ends of the recording."""
    pieces: list[_Piece] = []
    start, stored, lost_before = 0, first, 0
    for gap in sorted(recording.gaps, key=lambda gap: gap.first):
        place = gap.first - lost_before
        lost_before += gap.count
        if not (first < place < stop or place == first == 0 or place == stop == recording.frames):
            continue
        if place > stored:
            pieces.append(_Piece(start, place - stored, stored))
            start, stored = start + place - stored, place
        pieces.append(_Piece(start, gap.count, stored, _cause(recording, gap.cause)))
        start += gap.count
    if stop > stored:
        pieces.append(_Piece(start, stop - stored, stored))
    return pieces


def _cause(recording: Recording, text: str) -> Cause:
    try:
        return Cause(text)
    except ValueError as error:
        known = ", ".join(Cause)
        raise SourceError(f"the sidecar of {recording.path} has a gap by {text!r}; causes are {known}") from error
