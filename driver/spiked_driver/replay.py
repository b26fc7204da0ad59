"""A recording played as if it were the camera."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from spiked.recording import Recording

from spiked.errors import SourceError
from spiked.ring import Condition, DeviceState, End, EndReason, Gap
from spiked.sensor import Sensor
from spiked_driver.source import Chunk, Pacer


class ReplaySource:
    """Frames `first` to `stop - 1` of a recording, `repeat` times; the index starts at 0 and runs on over repeats.

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
        self._first = first
        self._length = last - first
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
        """The camera of the recording, with compact frames."""
        return self._recording.sensor.compact()

    @property
    def frames(self) -> int:
        """All repeats together."""
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
        """See `Source.read_into`; a chunk ends where a repeat ends."""
        if self._next == self.frames:
            self._condition = Condition(DeviceState.IDLE, "the recording is at its end")
            return End(self.frames, EndReason.FINISHED)
        offset = self._next % self._length
        count = min(len(view), self._length - offset)
        if not self._pacer.wait_for(self._next + count):
            return None
        self._condition = Condition(DeviceState.STREAMING)
        view[:count] = self._recording.compact(self._first + offset, count)
        chunk = Chunk(self._next, count)
        self._next += count
        return chunk
