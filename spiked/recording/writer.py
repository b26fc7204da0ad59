"""Writing recordings that survive being killed at any byte."""

import os
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spiked.errors import RecordingError
from spiked.recording.reader import REVERSED_BITS
from spiked.recording.sidecar import ClockPair, Gap, Sidecar, sidecar_path, write_sidecar
from spiked.sensor import BitOrder, Layout, Sensor


class RecordingWriter:
    """Appends frames to a new `.dat` file.

    A sidecar without a number of frames stands beside it from the start and is replaced by the final one on `close`,
    so whatever happens in between, the file can be read up to its last whole frame. Existing files are never
    overwritten.
    """

    def __init__(self, path: str | os.PathLike[str], sensor: Sensor, *, note: str = "", **more: Any) -> None:
        """`more` are further fields of the sidecar, for instance `device` or `calibration`."""
        self.path = Path(path)
        self.sensor = sensor
        self.frames = 0
        self._more: dict[str, Any] = {"note": note, **more}
        self._gaps: list[Gap] = []
        self._clock: list[ClockPair] = []
        beside = sidecar_path(self.path)
        if beside == self.path:
            raise RecordingError(f"{self.path}: a recording cannot have its sidecar's name; call it .dat")
        if beside.exists():
            raise RecordingError(f"{beside}: exists already; choose another name or remove it")
        try:
            # Unbuffered: what was appended is the kernel's, whatever becomes of this process.
            self._file = self.path.open("xb", buffering=0)
        except FileExistsError as error:
            raise RecordingError(f"{self.path}: exists already; choose another name or remove it") from error
        except OSError as error:
            raise RecordingError(f"{self.path}: cannot be written: {error.strerror}") from error
        self._write_sidecar(None)

    def append(self, frames: NDArray[np.uint8]) -> None:
        """Append compact frames, uint8 [n, height * row_bytes], LSB first, in the sensor's row order.

        They are stored in the sensor's layout and bit order. Raises RecordingError when the disk does not take them;
        the frames before remain valid.
        """
        compact = self.sensor.compact().frame_bytes
        if frames.ndim != 2 or frames.shape[1] != compact or frames.dtype != np.uint8:
            raise ValueError(f"frames must be uint8 [n, {compact}], not {frames.dtype} {list(frames.shape)}")
        rest = memoryview(self._stored(frames).tobytes())
        try:
            while rest:
                rest = rest[self._file.write(rest) :]
        except OSError as error:
            self._file.truncate(self.frames * self.sensor.frame_bytes)
            self._file.seek(0, os.SEEK_END)
            raise RecordingError(
                f"{self.path}: cannot be written: {error.strerror}; the first {self.frames} frames are safe"
            ) from error
        self.frames += len(frames)

    def _stored(self, frames: NDArray[np.uint8]) -> NDArray[np.uint8]:
        if self.sensor.bit_order is BitOrder.MSB:
            frames = REVERSED_BITS[frames]
        if self.sensor.layout is Layout.COMPACT:
            return frames
        height, row_bytes = self.sensor.height, self.sensor.row_bytes
        stored = np.empty((len(frames), height, row_bytes + 2), np.uint8)
        stored[:, :, :row_bytes] = frames.reshape(len(frames), height, row_bytes)
        stored[:, :, row_bytes:] = np.arange(height, dtype="<u2").view(np.uint8).reshape(height, 2)
        return stored.reshape(len(frames), self.sensor.frame_bytes)

    def gap(self, first: int, count: int, cause: str) -> None:
        """Note that `count` frames of the capture from `first` on (from the recording's first frame) are lost."""
        self._gaps.append(Gap(first=first, count=count, cause=cause))

    def clock_pair(self, frame: int, unix_ns: int) -> None:
        """Note the host's clock when a frame arrived."""
        self._clock.append(ClockPair(frame=frame, unix_ns=unix_ns))

    def close(self) -> None:
        """Finish the file and its sidecar; a second call does nothing."""
        if self._file.closed:
            return
        try:
            os.fsync(self._file.fileno())
        except OSError as error:
            raise RecordingError(f"{self.path}: cannot be finished: {error.strerror}") from error
        finally:
            self._file.close()
        self._write_sidecar(self.frames)

    def _write_sidecar(self, frames: int | None) -> None:
        sidecar = Sidecar.of(self.sensor, frames, gaps=tuple(self._gaps), clock=tuple(self._clock), **self._more)
        beside = sidecar_path(self.path)
        try:
            write_sidecar(beside, sidecar)
        except OSError as error:
            raise RecordingError(f"{beside}: cannot be written: {error.strerror}") from error

    def __enter__(self) -> "RecordingWriter":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()
