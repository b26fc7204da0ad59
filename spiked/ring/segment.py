"""The file in /dev/shm of a ring: layout, creation, attaching, and removal after its processes died.

A plain file and `mmap` are used, not `multiprocessing.shared_memory`, whose resource tracker unlinks segments that
other processes still use. The file is created without a name, filled, and then linked to `spiked-<id>`: the name always
refers to a complete ring, and a creator that is killed before leaves no file.

The header names two processes. The owner writes; readers check that it lives. The keeper, if any, starts the readers:
while it lives, only the keeper removes the name, so that a reader can attach after the last frame.
"""

import errno
import mmap
import os
import secrets
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError

from spiked.native._ring import Control
from spiked.ring.items import RingError
from spiked.ring.process import is_alive, own_identity
from spiked.sensor import Sensor

FOLDER = Path("/dev/shm")
PREFIX = "spiked-"
MIN_SLOTS = 8
"""Least number of slots: an eighth of them may be acquired ahead."""

_HEADER = struct.Struct("<8sQQQI")  # magic and version, owner, keeper, absent_readers, length of the JSON that follows
_MAGIC = b"spkring2"
_WORDS = slice(8, 32)
_CONTROL_OFFSET = mmap.PAGESIZE
_ENTRIES_A_SLOT = 4
"""Entries of the log (gaps, clock pairs, end) for each slot."""


@dataclass(frozen=True)
class RingLayout:
    """Sensor and sizes of a ring, stored as JSON in its header, so that its name is enough to attach."""

    sensor: Sensor
    """The sensor; frames are compact."""
    slots: int
    block_frames: int
    """Frames in a full slot."""

    @property
    def log_places(self) -> int:
        """Entries (blocks, losses, clock pairs) that the log keeps: enough for a loss before and after every block."""
        return _ENTRIES_A_SLOT * self.slots

    @property
    def slot_bytes(self) -> int:
        """Bytes of pixels in a full slot."""
        return self.block_frames * self.sensor.frame_bytes

    @property
    def slot_stride(self) -> int:
        """Bytes from slot to slot: whole pages, for transfers into slots."""
        return -(-self.slot_bytes // mmap.PAGESIZE) * mmap.PAGESIZE

    @property
    def data_offset(self) -> int:
        """Byte of the file at which slot 0 begins."""
        return _CONTROL_OFFSET + -(-int(Control.bytes(self.log_places)) // mmap.PAGESIZE) * mmap.PAGESIZE

    @property
    def total_bytes(self) -> int:
        """Bytes of the whole file."""
        return self.data_offset + self.slots * self.slot_stride


_LAYOUT = TypeAdapter(RingLayout)


class Segment:
    """The mapped memory of a ring. It stays mapped while a view of it exists, also after the file is unlinked."""

    def __init__(self, name: str, geometry: RingLayout, memory: NDArray[np.uint8]) -> None:
        self.name = name
        self.geometry = geometry
        self._words = memory[_WORDS].view("<u8")  # aligned: each word is written and read atomically
        control_bytes = Control.bytes(geometry.log_places)
        self.control = Control(memory[_CONTROL_OFFSET : _CONTROL_OFFSET + control_bytes], geometry.log_places)
        slots = memory[geometry.data_offset :].reshape(geometry.slots, geometry.slot_stride)
        self._slots = slots[:, : geometry.slot_bytes].reshape(geometry.slots, geometry.block_frames, -1)

    def slot(self, number: int, frames: int) -> NDArray[np.uint8]:
        """The first frames of a slot, uint8 [frames, frame_bytes], writable; slot numbers are absolute."""
        return self._slots[number % len(self._slots), :frames]

    @property
    def owner(self) -> int:
        """Identity of the process that writes, or has claimed the ring for a successor; 0: none."""
        return int(self._words[0])

    @owner.setter
    def owner(self, identity: int) -> None:
        self._words[0] = identity

    @property
    def keeper(self) -> int:
        """Identity of the process that removes the name; 0: the writer does."""
        return int(self._words[1])

    @property
    def absent_readers(self) -> int:
        """Number of awaited readers that will not attach."""
        return int(self._words[2])

    @absent_readers.setter
    def absent_readers(self, count: int) -> None:
        self._words[2] = count

    def unlink(self) -> None:
        """Remove the name; attached processes keep the memory. A removed name is no error."""
        (FOLDER / self.name).unlink(missing_ok=True)


def create_segment(geometry: RingLayout, ring_id: str | None, keeper: int = 0) -> Segment:
    """A new, zeroed ring named `spiked-<id>`; the id is random unless stated.

    Raises RingError if the name is taken or there is too little shared memory.
    """
    name = PREFIX + (ring_id if ring_id is not None else secrets.token_hex(4))
    owner = own_identity()
    text = _LAYOUT.dump_json(geometry)
    folder = os.open(FOLDER, os.O_DIRECTORY | os.O_PATH)
    file = os.open(FOLDER, os.O_TMPFILE | os.O_RDWR | os.O_CLOEXEC, 0o600)
    try:
        _reserve_memory(file, geometry.total_bytes, name)
        os.pwrite(file, _HEADER.pack(_MAGIC, owner, keeper, 0, len(text)) + text, 0)
        segment = Segment(name, geometry, _map(file, geometry, name))
        os.link(f"/proc/self/fd/{file}", name, dst_dir_fd=folder, follow_symlinks=True)
        return segment
    except FileExistsError as error:
        raise RingError(
            f"there is a ring {name} already: choose another id, or end the process that made it"
        ) from error
    finally:
        os.close(file)
        os.close(folder)


def attach_segment(name: str, *, writable: bool = True) -> Segment:
    """The ring of that name. Raises RingError if there is none, or if the file is not a ring of this version.

    Without `writable` the memory cannot be written: whatever this process does, the capture is not disturbed.
    """
    with _opened(FOLDER / name, os.O_RDWR if writable else os.O_RDONLY) as file:
        *_, geometry = _read_header(file, name)
        return Segment(name, geometry, _map(file, geometry, name, mmap.PROT_READ | (writable and mmap.PROT_WRITE)))


def clean_stale() -> list[str]:
    """Remove rings whose owner and keeper are dead; returns their names. Rings of other users are not touched."""
    removed = []
    for path in sorted(FOLDER.glob(PREFIX + "*")):
        try:
            with _opened(path) as file:
                owner, keeper, _ = _read_header(file, path.name)
        except RingError:
            continue  # removed meanwhile, of another user, or another file of such a name
        if not is_alive(owner) and not is_alive(keeper):
            path.unlink(missing_ok=True)
            removed.append(path.name)
    return removed


def remove_ring(ring_id: str) -> None:
    """Remove the name of a ring that this process keeps. A removed name is no error."""
    (FOLDER / (PREFIX + ring_id)).unlink(missing_ok=True)


@contextmanager
def _opened(path: Path, access: int = os.O_RDWR) -> Iterator[int]:
    try:
        file = os.open(path, access | os.O_CLOEXEC)
    except FileNotFoundError as error:
        raise RingError(f"there is no ring {path.name} in {FOLDER}") from error
    except OSError as error:
        raise RingError(f"ring {path.name} cannot be opened: {error.strerror}") from error
    try:
        yield file
    finally:
        os.close(file)


def _read_header(file: int, name: str) -> tuple[int, int, RingLayout]:
    head = os.pread(file, _CONTROL_OFFSET, 0)
    try:
        magic, owner, keeper, _, length = _HEADER.unpack_from(head)
        if magic != _MAGIC:
            raise RingError(f"{FOLDER / name} is not a ring of this version of spiked")
        geometry = _LAYOUT.validate_json(head[_HEADER.size : _HEADER.size + length])
    except (struct.error, ValidationError) as error:
        raise RingError(f"{FOLDER / name} has no readable ring header") from error
    if os.fstat(file).st_size != geometry.total_bytes:
        raise RingError(f"{FOLDER / name} has another length than its header states")
    return owner, keeper, geometry


def _reserve_memory(file: int, size: int, name: str) -> None:
    """Allocate the file's memory: with a sparse file, a full /dev/shm would cause SIGBUS during the capture."""
    try:
        os.posix_fallocate(file, 0, size)
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.ENOMEM, errno.EFBIG):
            raise
        stat = os.statvfs(FOLDER)
        free = stat.f_bavail * stat.f_frsize
        raise RingError(
            f"ring {name} needs {size / 2**20:.0f} MiB in {FOLDER} and {free / 2**20:.0f} MiB are free: "
            "use fewer slots, or enlarge it (a container has an option for its shared memory)"
        ) from error


def _map(
    file: int, geometry: RingLayout, name: str, protection: int = mmap.PROT_READ | mmap.PROT_WRITE
) -> NDArray[np.uint8]:
    """Map the whole file with all pages present: page faults would slow the first lap of a capture."""
    flags = mmap.MAP_SHARED | mmap.MAP_POPULATE
    try:
        memory = mmap.mmap(file, geometry.total_bytes, flags=flags, prot=protection)
    except OSError as error:
        raise RingError(
            f"ring {name} of {geometry.total_bytes / 2**20:.0f} MiB cannot be mapped: {error.strerror}; use fewer "
            "slots, or raise the memory limit of this process"
        ) from error
    return np.frombuffer(memory, np.uint8)
