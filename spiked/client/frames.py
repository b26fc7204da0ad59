"""Frames of a running capture, read where they lie: in the shared memory of the machine that the service runs on."""

import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from spiked.blocks import unpack
from spiked.client.connection import Connection
from spiked.client.models import CaptureOut, CaptureState
from spiked.errors import SpikedError
from spiked.recording import ClockPair
from spiked.recording.host_time import host_times_ns
from spiked.ring import End, EndReason, Frames, Gap, RingReader
from spiked.sensor import Sensor

_LOOK_S = 1.0
"""Longest wait for a block before waiting again, seconds: signals are handled in between."""
_POLL_S = 0.05
"""Interval at which a capture that starts is polled, seconds."""
_PAIRS = 64
"""Clock pairs kept, 16 s of them: times are extrapolated by the rate of the last 8 s."""


@dataclass(frozen=True)
class FrameBlock:
    """Frames `first` to `first + len(data) - 1` of the capture, which follow each other."""

    first: int
    data: NDArray[np.uint8]
    """As they lie in shared memory, a bit a pixel, uint8 [n, frame_bytes], read-only: copy what you keep."""
    lost: int
    """Frames between the last block and this one that did not come, of any cause."""
    unix_ns: NDArray[np.int64] | None
    """Unix times at which the frames had arrived whole, int64 [n]; None until the service has measured them (4 s)."""
    _sensor: Sensor = field(repr=False)
    _frames: Frames = field(repr=False)

    @property
    def numbers(self) -> NDArray[np.int64]:
        """Numbers of the frames in the capture, int64 [n]."""
        return np.arange(self.first, self.first + len(self.data), dtype=np.int64)

    def spikes(self) -> NDArray[np.uint8]:
        """A copy with a byte a pixel, 1 for a spike, uint8 [n, height, width], upright."""
        return unpack(self.data, self._sensor)

    def intact(self) -> bool:
        """Whether `data` was not overwritten up to now. Ask when you have used it: if not, forget what you computed.

        The first answer, or taking the next block, decides whether the block counts as lost, as part of the next
        block's `lost` and of the stream's: later answers change no count.
        """
        return self._frames.release() and self._frames.present()


class FrameStream:
    """Blocks of the frames of a running capture, from the newest on until its end. Used by one thread.

    The service does not know of it: a stream that is read slowly, or whose process is killed, disturbs nothing. Who
    lags by more than half of the ring (a quarter of a second of a small camera at least) loses frames, and is told.
    """

    def __init__(self, ring: str) -> None:
        """Attach to the ring of that name (`ring` of a capture). Raises RingError if there is none for this user."""
        self._reader = RingReader.watch(ring)
        self._pairs: list[ClockPair] = []
        self.lost = 0
        """Frames that did not come since the beginning of the stream, of any cause."""
        self.end: EndReason | None = None
        """Why the capture has ended; None before."""

    @property
    def sensor(self) -> Sensor:
        """The camera."""
        return self._reader.geometry.sensor

    def __iter__(self) -> Iterator[FrameBlock]:
        before = self.lost
        while self.end is None:
            item = self._reader.next(_LOOK_S)
            match item:
                case Gap():
                    self.lost += item.count
                case End():
                    self.end = item.reason
                case Frames():
                    yield FrameBlock(item.first, item.data, self.lost - before, self._times(item), self.sensor, item)
                    before = self.lost

    def close(self) -> None:
        """Let go of the ring; blocks that are still held keep its memory."""
        self._reader.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _times(self, frames: Frames) -> NDArray[np.int64] | None:
        new = [ClockPair(frame=pair.frame, unix_ns=pair.unix_ns) for pair in self._reader.clock_pairs()]
        self._pairs = [*self._pairs, *new][-_PAIRS:]
        if not self._pairs:
            return None
        numbers = np.arange(frames.first, frames.first + frames.count)
        return host_times_ns(self._pairs, numbers, self.sensor.frame_rate_hz)


class FrameMethods:
    """What `Spiked` does with frames as they come."""

    _connection: Connection

    def frames(self, capture_id: str, *, timeout_s: float = 30.0) -> FrameStream:
        """The frames of a running capture, for a program on the service's machine that runs as the same user.

        Waits for a capture that is starting. Raises SpikedError if the capture does not run, RingError if its frames
        are on another machine or another user's.
        """
        deadline_s = time.monotonic() + timeout_s
        while True:
            capture = self._connection.get(f"captures/{capture_id}", CaptureOut)
            if capture.ring is not None or capture.state is not CaptureState.starting or time.monotonic() > deadline_s:
                break
            time.sleep(_POLL_S)
        if capture.ring is None:
            raise SpikedError(
                f"capture {capture_id} is {capture.state.value}: frames can be read while it runs; see `save_recording`"
            )
        return FrameStream(capture.ring)
