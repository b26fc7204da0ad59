"""The files of a checkpoint: one state that is replaced as a whole, and arrays that are written once.

`state` is replaced atomically: a magic, the length of a JSON header, the header, the payload, and a digest of all
that. `arrays-N` grows; the header says how much of it belongs to the state, with a digest. A kill at any moment leaves
the state before or the new one, and at most some bytes at the end of `arrays-N` that no state knows.
"""

import errno
import fcntl
import hashlib
import json
import os
import shutil
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from spiked.errors import CheckpointError

CHECKPOINT = "checkpoint"
"""Name of the folder of a checkpoint, among the results."""
FORMAT = 1
"""Number of the layout described above; a program reads its own only."""
RESERVE_BYTES = 256 << 20
"""Free space, or a twentieth of a smaller disk, that checkpoints leave for recordings and results."""
_MAGIC = b"spiked checkpoint\n"
_DIGEST_BYTES = 16
"""Of BLAKE2b: it tells damage, not malice."""
_LENGTH_BYTES = 4
"""Of the header's length, little-endian."""
_STATE, _PART, _ARRAYS = "state", "state.part", "arrays-"
_LOCK = "lock"
LOCK_S = 3.0
"""Time for another process to end: a worker outlives a killed service by less than a second."""
_PIECE_BYTES = 1 << 20
"""Of a file that is copied."""
_ALIGNED_BYTES = 64
"""Arrays begin at multiples of it, for the compiled code."""


def _blake(*contents: Any) -> Any:
    digest = hashlib.blake2b(digest_size=_DIGEST_BYTES)
    for content in contents:
        digest.update(content)
    return digest


@dataclass(frozen=True)
class Place:
    """Where an array lies in `arrays-N`."""

    begin: int
    dtype: str
    shape: tuple[int, ...]

    @property
    def bytes(self) -> int:
        """Its size."""
        return int(np.dtype(self.dtype).itemsize * np.prod(self.shape, dtype=np.int64))

    @property
    def end(self) -> int:
        """Where the next array begins."""
        return self.begin + -(-self.bytes // _ALIGNED_BYTES) * _ALIGNED_BYTES


@dataclass
class State:
    """What was read: header, payload and the arrays."""

    header: dict[str, Any]
    payload: bytes
    arrays: NDArray[np.uint8]
    """[bytes], its content."""

    def array(self, place: Place) -> NDArray[Any]:
        """The read-only array at a place. Raises CheckpointError."""
        if not 0 <= place.begin <= place.begin + place.bytes <= len(self.arrays):
            raise CheckpointError("an array lies outside of its file")
        content = self.arrays[place.begin : place.begin + place.bytes]
        return content.view(np.dtype(place.dtype)).reshape(place.shape)


@dataclass
class CheckpointFolder:
    """Writes the states of one run into a folder. One process at a time."""

    path: Path
    _lock: BinaryIO | None = None
    _number: int = 0
    _size: int = 0
    _digest: Any = field(default_factory=_blake)

    @property
    def arrays_bytes(self) -> int:
        """Size of the current `arrays-N`: where the next array is going to begin."""
        return self._size

    def lock(self) -> None:
        """Make the folder and keep other processes out of it; called again it does nothing.

        Raises OSError, and CheckpointError if another process still writes there after `LOCK_S`.
        """
        if self._lock is not None:
            return
        self.path.mkdir(parents=True, exist_ok=True)
        lock = (self.path / _LOCK).open("ab")
        deadline = time.monotonic() + LOCK_S
        while not _locked(lock):
            if time.monotonic() > deadline:
                lock.close()
                raise CheckpointError(f"{self.path}: another process works there; wait for its end, or end it")
            time.sleep(LOCK_S / 100)
        self._lock = lock
        found = [path.name.removeprefix(_ARRAYS) for path in self.path.glob(f"{_ARRAYS}*")]
        self._number = 1 + max((int(number) for number in found if number.isdecimal()), default=0)

    def begin_arrays(self) -> None:
        """Let the next `write` begin a new file of arrays."""
        self._number, self._size, self._digest = self._number + 1, 0, _blake()

    def write(self, header: Mapping[str, Any], payload: bytes, arrays: list[NDArray[Any]]) -> None:
        """Append arrays, sync them, and replace the state. Raises OSError; the state before is whole then.

        The arrays lie one after another from `arrays_bytes` on, as `Place.end` says.
        """
        self.lock()
        self._check_space(len(payload) + sum(array.nbytes for array in arrays))
        size, digest = self._size, self._digest.copy()
        name = self.path / f"{_ARRAYS}{self._number}"
        with os.fdopen(os.open(name, os.O_WRONLY | os.O_CREAT, 0o666), "wb") as file:
            file.truncate(size)
            file.seek(size)
            for array in arrays:
                place = Place(size, array.dtype.str, array.shape)
                padded = np.zeros(place.end - size, np.uint8)
                padded[: place.bytes] = np.ascontiguousarray(array).reshape(-1).view(np.uint8)
                file.write(padded.data)
                digest.update(padded.data)
                size = place.end
            file.flush()
            os.fdatasync(file.fileno())
        described = {
            **header,
            "format": FORMAT,
            "arrays": {"number": self._number, "bytes": size, "digest": digest.hexdigest()},
        }
        head = json.dumps(described).encode()
        whole = [_MAGIC, len(head).to_bytes(_LENGTH_BYTES, "little"), head, payload]
        part = self.path / _PART
        with part.open("wb") as file:
            for content in whole:
                file.write(content)
            file.write(_blake(*whole).digest())
            file.flush()
            os.fdatasync(file.fileno())
        part.replace(self.path / _STATE)
        _sync_folder(self.path)
        self._size, self._digest = size, digest
        for other in self.path.glob(f"{_ARRAYS}*"):
            if other != name:
                other.unlink()

    def _check_space(self, wanted: int) -> None:
        """Raises OSError ENOSPC if less than the reserve would be left."""
        disk = os.statvfs(self.path)
        if disk.f_bavail * disk.f_frsize - wanted < min(RESERVE_BYTES, disk.f_blocks * disk.f_frsize // 20):
            raise OSError(errno.ENOSPC, f"less than {RESERVE_BYTES >> 20} MiB would be left on the disk")

    def remove(self) -> None:
        """Delete the folder."""
        if self._lock is not None:
            self._lock.close()
            self._lock = None
        if self.path.exists():
            (self.path / _STATE).unlink(missing_ok=True)  # first: without it there is no checkpoint
            shutil.rmtree(self.path)

    def close(self) -> None:
        """Let others into the folder."""
        if self._lock is not None:
            self._lock.close()
            self._lock = None


def exists(path: Path) -> bool:
    """Whether there is a checkpoint in a folder, of whatever quality."""
    return (path / _STATE).exists()


def files_of(path: Path) -> list[Path]:
    """The files of the checkpoint in a folder, those of arrays first."""
    return [*sorted(path.glob(f"{_ARRAYS}*")), *path.glob(_STATE)]


def copy_newest(path: Path, to: Path) -> bool:
    """Copy the newest state, whose owner may be writing others. Return False if there is none.

    Raises OSError, and CheckpointError if its header cannot be read.
    """
    shutil.rmtree(to, ignore_errors=True)
    to.mkdir(parents=True)
    while True:
        try:
            state = (path / _STATE).read_bytes()
        except FileNotFoundError:
            return False
        try:
            arrays = _header(state, path)[0]["arrays"]
            name, left = f"{_ARRAYS}{arrays['number']}", arrays["bytes"]
            with (path / name).open("rb") as source, (to / name).open("wb") as target:
                while left and (piece := source.read(min(left, _PIECE_BYTES))):
                    target.write(piece)
                    left -= len(piece)
        except FileNotFoundError:
            (to / name).unlink(missing_ok=True)
            continue  # there is a newer state, with another file
        (to / _STATE).write_bytes(state)
        return True


def _header(content: bytes, path: Path) -> tuple[dict[str, Any], int]:
    """The header of a state of this format, and where its payload begins. Raises CheckpointError."""
    begin = len(_MAGIC) + _LENGTH_BYTES
    end = begin + int.from_bytes(content[len(_MAGIC) : begin], "little")
    try:
        header: dict[str, Any] = json.loads(content[begin:end])
        layout = header["format"]
    except (ValueError, KeyError, TypeError) as error:
        raise CheckpointError(f"{path}: its checkpoint is damaged: its header cannot be read") from error
    if layout != FORMAT:
        raise CheckpointError(f"{path}: its checkpoint has format {layout}, and this program reads {FORMAT}")
    return header, end


def read(path: Path) -> State:
    """The state in a folder. Raises CheckpointError, also for one of another format."""
    try:
        content = (path / _STATE).read_bytes()
    except FileNotFoundError as error:
        raise CheckpointError(f"{path}: there is no checkpoint") from error
    except OSError as error:
        raise CheckpointError(f"{path}: its checkpoint cannot be read: {error.strerror}") from error
    begin = len(_MAGIC) + _LENGTH_BYTES
    if not content.startswith(_MAGIC) or len(content) < begin + _DIGEST_BYTES:
        raise CheckpointError(f"{path}: its checkpoint is damaged: it does not begin as one")
    if _blake(content[:-_DIGEST_BYTES]).digest() != content[-_DIGEST_BYTES:]:
        raise CheckpointError(f"{path}: its checkpoint is damaged: its digest does not fit its {len(content)} bytes")
    header, end = _header(content, path)
    arrays = header["arrays"]
    name = path / f"{_ARRAYS}{arrays['number']}"
    try:
        stored = np.fromfile(name, np.uint8, arrays["bytes"])
    except OSError as error:
        raise CheckpointError(f"{name} cannot be read: {error.strerror}") from error
    if len(stored) != arrays["bytes"] or _blake(stored).hexdigest() != arrays["digest"]:
        raise CheckpointError(f"{name} is damaged: its first {arrays['bytes']} bytes are not those of the checkpoint")
    stored.flags.writeable = False
    return State(header, content[end:-_DIGEST_BYTES], stored)


def _locked(file: BinaryIO) -> bool:
    """Lock a file, unless another process has it."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _sync_folder(path: Path) -> None:
    folder = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
