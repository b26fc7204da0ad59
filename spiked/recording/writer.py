"""Writing recordings that survive being killed at any byte."""

import os
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from isal.isal_zlib import crc32
from numpy.typing import NDArray

from spiked.errors import RecordingError
from spiked.recording.appender import Appender
from spiked.recording.durability import PLAIN, Allocator, Durability, Sync, Syncer
from spiked.recording.index import IndexWriter, index_path
from spiked.recording.reader import REVERSED_BITS
from spiked.recording.recover import recover
from spiked.recording.sidecar import ClockPair, Gap, Sidecar, reserve_sidecar, sidecar_path, write_sidecar
from spiked.sensor import BitOrder, Layout, Sensor


@dataclass
class _Files:
    frames: Appender
    index: IndexWriter | None
    allocator: Allocator
    syncer: Syncer | None = None


class RecordingWriter:
    """Appends frames to a new `.dat` file.

    A sidecar without a number of frames stands beside it from the start and is replaced by the final one on `close`,
    so whatever happens in between, the file can be read up to its last whole frame. Existing files are never
    overwritten. Used by one thread.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        sensor: Sensor,
        *,
        note: str = "",
        durability: Durability = PLAIN,
        **more: Any,
    ) -> None:
        """`more` are further fields of the sidecar, for instance `device` or `calibration`."""
        self._prepare(Path(path), sensor, durability, {"note": note, **more})
        beside = sidecar_path(self.path)
        if beside == self.path:
            raise RecordingError(f"{self.path}: a recording cannot have its sidecar's name; call it .dat")
        if beside.exists():
            raise RecordingError(f"{beside}: exists already; choose another name or remove it")
        try:
            self._files = self._open(resume=False)
        except FileExistsError as error:
            raise RecordingError(f"{error.filename}: exists already; choose another name or remove it") from error
        except OSError as error:
            raise RecordingError(f"{self.path}: cannot be written: {error.strerror}") from error
        self._write_sidecar(None)
        self._reserve()

    @classmethod
    def resume(cls, path: str | os.PathLike[str], *, durability: Durability = PLAIN) -> Self:
        """Go on with an unfinished recording whose writer has died, behind its last whole block.

        Raises RecordingError if there is none, or it cannot be read.
        """
        recovered = recover(Path(path))
        sidecar = recovered.sidecar
        self = cls.__new__(cls)
        kept = {"format", "width", "height", "frame_rate", "frames", "bit_order", "flipped", "cfa", "intrinsics"}
        kept |= {"pixel_centre", "gaps", "clock"}
        more = {name: getattr(sidecar, name) for name in sidecar.model_fields_set - kept}
        self._prepare(Path(path), sidecar.sensor(), durability, more)
        self.frames = recovered.frames
        self._gaps, self._clock = list(sidecar.gaps), list(sidecar.clock)
        self._next = recovered.frames + sum(gap.count for gap in sidecar.gaps)
        try:
            self._files = self._open(resume=True)
        except OSError as error:
            raise RecordingError(f"{path}: cannot be written: {error.strerror}") from error
        self._write_sidecar(None)
        self._reserve()
        return self

    def _prepare(self, path: Path, sensor: Sensor, durability: Durability, more: dict[str, Any]) -> None:
        self.path = path
        self.sensor = sensor
        self.frames = 0
        """Frames in the file."""
        self._durability = durability
        self._more = more
        self._gaps: list[Gap] = []
        self._clock: list[ClockPair] = []
        self._next = 0
        self._closed = False

    def _open(self, *, resume: bool) -> _Files:
        frames = Appender(self.path, resume=resume, direct=self._durability.direct)
        index = None
        beside = index_path(self.path)
        if self._durability.index and (not resume or beside.exists()):
            index = IndexWriter(beside, self.sensor.frame_bytes, resume=resume)
        files = _Files(frames, index, Allocator(frames.fileno(), self._durability, self.bytes))
        if self._durability.sync is Sync.SECOND:
            files.syncer = Syncer(frames.fileno(), self.bytes, lambda: self._sync(files))
        return files

    @property
    def bytes(self) -> int:
        """Size of the frames in the file."""
        return self.frames * self.sensor.frame_bytes

    @property
    def next_frame(self) -> int:
        """Index of the next frame, counted from the recording's first, lost ones included."""
        return self._next

    @property
    def gaps(self) -> tuple[Gap, ...]:
        """The losses so far."""
        return tuple(self._gaps)

    def append(self, frames: NDArray[np.uint8], *, cached: bool = False) -> None:
        """Append compact frames, uint8 [n, height * row_bytes], LSB first, in the sensor's row order.

        They are stored in the sensor's layout and bit order. With `cached`, the kernel may keep them in memory for a
        disk that is behind. Raises RecordingError when the disk does not take them; the frames before remain valid.
        """
        compact = self.sensor.compact().frame_bytes
        if frames.ndim != 2 or frames.shape[1] != compact or frames.dtype != np.uint8:
            raise ValueError(f"frames must be uint8 [n, {compact}], not {frames.dtype} {list(frames.shape)}")
        stored = np.ascontiguousarray(self._stored(frames)).reshape(-1)
        files, offset = self._files, self.bytes
        entries = files.index.entries if files.index is not None else 0
        try:
            if files.syncer is not None:
                files.syncer.check()
            files.allocator.before(offset + stored.nbytes)
            files.frames.append(stored, cached)
            if files.index is not None:
                files.index.frames(self._next, len(frames), offset, crc32(stored))
            if self._durability.sync is Sync.BLOCK:
                self._sync(files)
        except OSError as error:
            with suppress(OSError):  # on a disk gone read-only the unfinished block stays, and is not counted
                files.frames.cut(offset)
                if files.index is not None:
                    files.index.retract(entries)
            raise RecordingError(
                f"{self.path}: cannot be written: {error.strerror}; the first {self.frames} frames are safe"
            ) from error
        self.frames += len(frames)
        self._next += len(frames)
        if files.syncer is not None:
            files.syncer.written(self.bytes)

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
        """Note that `count` frames of the capture from `first` on (from the recording's first frame) are lost.

        With an index, gaps come in order with the frames. Raises RecordingError when the disk does not take it.
        """
        if self._files.index is not None and first != self._next:
            raise ValueError(f"a gap from frame {first} was told when frame {self._next} was next")
        self._gaps.append(Gap(first=first, count=count, cause=cause))
        self._next += count
        self._note(lambda index: index.gap(first, count, cause))

    def clock_pair(self, frame: int, unix_ns: int) -> None:
        """Note the host's clock when a frame arrived. Raises RecordingError when the disk does not take it."""
        self._clock.append(ClockPair(frame=frame, unix_ns=unix_ns))
        self._note(lambda index: index.clock(frame, unix_ns))

    def close(self) -> None:
        """Finish the file and its sidecar; a second call does nothing. Raises RecordingError."""
        if self._closed:
            return
        self._closed = True
        files = self._files
        if files.syncer is not None:
            files.syncer.close()
        try:
            files.frames.cut(self.bytes)  # gives back what was taken in advance
            self._sync(files)
        except OSError as error:
            raise RecordingError(f"{self.path}: cannot be finished: {error.strerror}") from error
        finally:
            files.frames.close()
            if files.index is not None:
                files.index.close()
        self._write_sidecar(self.frames)

    def _note(self, tell: Callable[[IndexWriter], None]) -> None:
        if self._files.index is None:
            return
        try:
            tell(self._files.index)
        except OSError as error:
            raise RecordingError(f"{index_path(self.path)}: cannot be written: {error.strerror}") from error

    def _sync(self, files: _Files) -> None:
        """What the index tells of before the sync begins is on the disk after it."""
        told = files.index.entries if files.index is not None else 0
        os.fdatasync(files.frames.fileno())
        if files.index is not None:
            os.fdatasync(files.index.fileno())
            files.index.synced(told)

    def _reserve(self) -> None:
        if self._durability.reserve_bytes:
            with suppress(OSError):  # the disk may be full already, which the first frames will tell
                reserve_sidecar(sidecar_path(self.path))

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
