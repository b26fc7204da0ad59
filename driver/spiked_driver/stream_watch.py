"""Detects a camera that sends nothing, or bytes without a frame."""

import time

import numpy as np
from numpy.typing import NDArray

from spiked_driver.source import READ_WAIT_S

_MAX_STEP_S = 2 * READ_WAIT_S
"""Most time counted between two reads, seconds: a suspended process does not make the camera silent."""
_SHOWN_BYTES = 16
"""First bytes shown in the message about a stream without frames: the length of a frame header."""


class StreamWatch:
    """Time since the last byte and since the last frame. Only time in which this process reads counts."""

    def __init__(self, rate_bytes: float) -> None:
        """`rate_bytes`: bytes a second that the camera sends."""
        self._rate_bytes = rate_bytes
        self.silent_s = 0.0
        """Seconds since the last byte."""
        self._frameless_s = 0.0
        self._bytes = 0
        self._first = b""
        self._updated_s = 0.0
        self._frames = 0
        self.restart()

    @property
    def frameless_s(self) -> float:
        """Seconds since the last frame: time spent reading or bytes divided by the data rate, the larger."""
        return max(self._frameless_s, self._bytes / self._rate_bytes)

    def restart(self) -> None:
        """Reading starts, for the first time or again."""
        self.silent_s = 0.0
        self._updated_s = time.monotonic()
        self._clear()

    def update(self, data: NDArray[np.uint8], frames: int) -> None:
        """One read returned `data`, uint8 [n >= 0]; `frames` frames had been received before it."""
        now_s = time.monotonic()
        step_s = min(now_s - self._updated_s, _MAX_STEP_S)
        self._updated_s = now_s
        if not data.size:
            self.silent_s += step_s
            return
        self.silent_s = 0.0
        self._frameless_s += step_s if self._bytes else 0.0
        self._first = self._first or data[:_SHOWN_BYTES].tobytes()
        self._bytes += data.size
        if frames != self._frames:
            self._frames = frames
            self._clear()

    def describe(self) -> str:
        """The bytes received instead of frames, for an error message."""
        return f"{self._bytes / 1e6:.1f} MB read, no frame found; first bytes {self._first.hex(' ')}"

    def _clear(self) -> None:
        """A frame was received: start counting anew."""
        self._frameless_s = 0.0
        self._bytes = 0
        self._first = b""
