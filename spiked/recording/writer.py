"""Writes recordings that stay valid if the writer is killed at any byte."""

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
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

    It has a sidecar without a number of frames from the start, which `close` replaces by the final one. The file can
    therefore be read up to its last whole frame at any time. Existing files are never overwritten. Used by one thread.
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
        """Continue the unfinished recording of a dead writer after its last complete block.

        Raises RecordingError if there is none, or it cannot be read.
        """
        recovered = recover(Path(path))
        sidecar = recovered.sidecar
        self = cls.__new__(cls)
        kept = {"format", "width", "height", "frame_rate", "frames", "bit_order", "flipped", "cfa", "intrinsics"}
        kept |= {"response", "pixel_centre", "gaps", "clock"}
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
            try:
                index = IndexWriter(beside, self.sensor.frame_bytes, resume=resume)
            except BaseException:
                frames.close()
                if not resume:
                    self.path.unlink()  # without it the recording can be begun again
                raise
        files = _Files(frames, index, Allocator(frames.fileno(), self._durability, self.bytes))
        if self._durability.sync is Sync.SECOND:
            files.syncer = Syncer(frames.fileno(), self.bytes, lambda: self._sync(files))
        return files

    @property
    def bytes(self) -> int:
        """Bytes of the frames in the file."""
        return self.frames * self.sensor.frame_bytes

    @property
    def direct_bytes(self) -> int:
        """Bytes written past the page cache."""
        return self._files.frames.direct_bytes

    @property
    def next_frame(self) -> int:
        """Index of the next frame, counted from the recording's first, lost ones included."""
        return self._next

    @property
    def gaps(self) -> tuple[Gap, ...]:
        """The gaps so far."""
        return tuple(self._gaps)

    @property
    def clock(self) -> Sequence[ClockPair]:
        """The clock pairs so far."""
        return self._clock

    def append(self, frames: NDArray[np.uint8], *, cached: bool = False) -> None:
        """Append compact frames, uint8 [n, height * row_bytes], LSB first, in the sensor's row order.

        They are stored in the sensor's layout and bit order. With `cached`, they go through the page cache, for a slow
        disk. Raises RecordingError if they cannot be written; the frames before remain valid.
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
            with suppress(OSError):  # on a read-only disk the unfinished block stays and is not counted
                files.frames.cut(offset)
                files.allocator.cut(offset)
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
        """Add a gap of `count` frames from `first` on, counted from the recording's first frame.

        With an index, gaps must be in order with the frames. Raises RecordingError if it cannot be written.
        """
        if self._files.index is not None and first != self._next:
            raise ValueError(f"a gap from frame {first} was reported when frame {self._next} was next")
        before = self._gaps[-1] if self._gaps else None
        if before is not None and before.cause == cause and before.first + before.count == first:
            self._gaps[-1] = before.model_copy(update={"count": before.count + count})
        else:
            self._gaps.append(Gap(first=first, count=count, cause=cause))
        self._next += count
        self._append_entry(lambda index: index.gap(first, count, cause))

    def clock_pair(self, frame: int, unix_ns: int) -> None:
        """Add a clock pair. Raises RecordingError if it cannot be written."""
        self._clock.append(ClockPair(frame=frame, unix_ns=unix_ns))
        self._append_entry(lambda index: index.clock(frame, unix_ns))

    def close(self) -> None:
        """Finish the file and its sidecar; a second call does nothing. Raises RecordingError."""
        if self._closed:
            return
        self._closed = True
        files = self._files
        if files.syncer is not None:
            files.syncer.close()
        try:
            if files.syncer is not None:
                files.syncer.check()  # the kernel tells an error of writing once: the sync below would succeed
            files.frames.cut(self.bytes)  # releases preallocated space
            self._sync(files)
        except OSError as error:
            raise RecordingError(f"{self.path}: cannot be finished: {error.strerror}") from error
        finally:
            files.frames.close()
            if files.index is not None:
                files.index.close()
        self._write_sidecar(self.frames)

    def _append_entry(self, write: Callable[[IndexWriter], None]) -> None:
        if self._files.index is None:
            return
        try:
            write(self._files.index)
        except OSError as error:
            raise RecordingError(f"{index_path(self.path)}: cannot be written: {error.strerror}") from error

    def _sync(self, files: _Files) -> None:
        """Sync the frames, then the index; note in it the entries that existed before."""
        synced = files.index.entries if files.index is not None else 0
        os.fdatasync(files.frames.fileno())
        if files.index is not None:
            os.fdatasync(files.index.fileno())
            files.index.synced(synced)

    def _reserve(self) -> None:
        if self._durability.reserve_bytes:
            with suppress(OSError):  # the disk may be full already; the first frames will report it
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


@contextmanager
def whole_recording(path: Path, sensor: Sensor, **more: Any) -> Iterator[RecordingWriter]:
    """A recording that is made of something else: after an error, or Ctrl-C, nothing of it is left.

    A part of it would pass for a shorter recording. `more` as of `RecordingWriter`. Raises RecordingError.
    """
    new = not any(file.exists() for file in _files_of(path))
    try:
        with RecordingWriter(path, sensor, **more) as writer:
            yield writer
    except BaseException:
        if new:
            remove_recording(path)
        raise


def remove_recording(path: Path) -> None:
    """Remove a recording with its sidecar and index, as far as they exist. Raises OSError."""
    for file in _files_of(path):
        file.unlink(missing_ok=True)


def _files_of(path: Path) -> tuple[Path, ...]:
    return path, sidecar_path(path), index_path(path)
