"""The file in /dev/shm behind a ring: layout, creation, attaching, and the cleaning up after dead creators.

A plain file and `mmap`, not `multiprocessing.shared_memory`, whose resource tracker unlinks segments that other
processes still use. The file is made without a name, filled, and only then linked to `spiked-<id>`: under that name
there is a whole ring or nothing, and a creator killed before leaves nothing behind.
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

_HEADER = struct.Struct("<8sQI")  # magic with the layout's version, identity of the creator, bytes of JSON that follow
_MAGIC = b"spkring1"
_OWNER_OFFSET = len(_MAGIC)
_CONTROL_OFFSET = mmap.PAGESIZE
_ENTRIES_A_SLOT = 4


@dataclass(frozen=True)
class Geometry:
    """What a ring holds, kept as JSON in its header so that a name is enough to attach."""

    sensor: Sensor
    """The camera; frames are compact."""
    slots: int
    block_frames: int
    """Frames in a full slot."""

    @property
    def log_places(self) -> int:
        """Entries (blocks and losses) that the log keeps: enough for a loss before and after every block."""
        return _ENTRIES_A_SLOT * self.slots

    @property
    def slot_bytes(self) -> int:
        """Bytes of pixels in a full slot."""
        return self.block_frames * self.sensor.frame_bytes

    @property
    def slot_stride(self) -> int:
        """Bytes from slot to slot: whole pages, as USB transfers like them."""
        return -(-self.slot_bytes // mmap.PAGESIZE) * mmap.PAGESIZE

    @property
    def data_offset(self) -> int:
        """Byte of the file at which slot 0 begins."""
        return _CONTROL_OFFSET + -(-int(Control.bytes(self.log_places)) // mmap.PAGESIZE) * mmap.PAGESIZE

    @property
    def total_bytes(self) -> int:
        """Bytes of the whole file."""
        return self.data_offset + self.slots * self.slot_stride


_GEOMETRY = TypeAdapter(Geometry)


class Segment:
    """The mapped memory of a ring. It stays mapped while any view of it lives, also after the file is unlinked."""

    def __init__(self, name: str, geometry: Geometry, memory: NDArray[np.uint8]) -> None:
        self.name = name
        self.geometry = geometry
        self._owner = memory[_OWNER_OFFSET : _OWNER_OFFSET + 8].view("<u8")  # aligned: written and read in one piece
        control_bytes = Control.bytes(geometry.log_places)
        self.control = Control(memory[_CONTROL_OFFSET : _CONTROL_OFFSET + control_bytes], geometry.log_places)
        slots = memory[geometry.data_offset :].reshape(geometry.slots, geometry.slot_stride)
        self._slots = slots[:, : geometry.slot_bytes].reshape(geometry.slots, geometry.block_frames, -1)

    def slot(self, number: int, frames: int) -> NDArray[np.uint8]:
        """The first frames of a slot, uint8 [frames, frame_bytes], writable; slot numbers are absolute."""
        return self._slots[number % len(self._slots), :frames]

    @property
    def owner(self) -> int:
        """Identity of the process that writes, or holds the ring for the one that is to go on writing; 0: nobody."""
        return int(self._owner[0])

    @owner.setter
    def owner(self, identity: int) -> None:
        self._owner[0] = identity

    def unlink(self) -> None:
        """Remove the name; processes that are attached keep the memory. Fine if it is gone already."""
        (FOLDER / self.name).unlink(missing_ok=True)


def create_segment(geometry: Geometry, ring_id: str | None) -> Segment:
    """A new, zeroed ring named `spiked-<id>`, the id random unless given.

    Raises RingError if the name is taken or the memory is not there.
    """
    name = PREFIX + (ring_id if ring_id is not None else secrets.token_hex(4))
    owner = own_identity()
    text = _GEOMETRY.dump_json(geometry)
    folder = os.open(FOLDER, os.O_DIRECTORY | os.O_PATH)
    file = os.open(FOLDER, os.O_TMPFILE | os.O_RDWR | os.O_CLOEXEC, 0o600)
    try:
        _reserve_memory(file, geometry.total_bytes, name)
        os.pwrite(file, _HEADER.pack(_MAGIC, owner, len(text)) + text, 0)
        os.link(f"/proc/self/fd/{file}", name, dst_dir_fd=folder, follow_symlinks=True)
        return Segment(name, geometry, _map(file, geometry))
    except FileExistsError as error:
        raise RingError(
            f"there is a ring {name} already: choose another id, or end the process that made it"
        ) from error
    finally:
        os.close(file)
        os.close(folder)


def attach_segment(name: str) -> Segment:
    """The ring of that name. Raises RingError if there is none, or if the file is not a ring of this version."""
    with _opened(FOLDER / name) as file:
        _, geometry = _read_header(file, name)
        return Segment(name, geometry, _map(file, geometry))


def clean_stale() -> list[str]:
    """Unlink the rings whose creator is dead, and return their names. Rings of other users are left to them."""
    removed = []
    for path in sorted(FOLDER.glob(PREFIX + "*")):
        try:
            with _opened(path) as file:
                owner, _ = _read_header(file, path.name)
        except RingError:
            continue  # vanished meanwhile, of another user, or only named like a ring
        if not is_alive(owner):
            path.unlink(missing_ok=True)
            removed.append(path.name)
    return removed


@contextmanager
def _opened(path: Path) -> Iterator[int]:
    try:
        file = os.open(path, os.O_RDWR | os.O_CLOEXEC)
    except FileNotFoundError as error:
        raise RingError(f"there is no ring {path.name} in {FOLDER}: is its capture over?") from error
    except OSError as error:
        raise RingError(f"ring {path.name} cannot be opened: {error.strerror}") from error
    try:
        yield file
    finally:
        os.close(file)


def _read_header(file: int, name: str) -> tuple[int, Geometry]:
    head = os.pread(file, _CONTROL_OFFSET, 0)
    try:
        magic, owner, length = _HEADER.unpack_from(head)
        if magic != _MAGIC:
            raise RingError(f"{FOLDER / name} is not a ring of this version of spiked")
        geometry = _GEOMETRY.validate_json(head[_HEADER.size : _HEADER.size + length])
    except (struct.error, ValidationError) as error:
        raise RingError(f"{FOLDER / name} has no readable ring header") from error
    if os.fstat(file).st_size != geometry.total_bytes:
        raise RingError(f"{FOLDER / name} is not as long as its header says")
    return owner, geometry


def _reserve_memory(file: int, size: int, name: str) -> None:
    """Allocate now: a sparse file would end in SIGBUS in the middle of a capture when /dev/shm is full."""
    try:
        os.posix_fallocate(file, 0, size)
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.ENOMEM, errno.EFBIG):
            raise
        stat = os.statvfs(FOLDER)
        free = stat.f_bavail * stat.f_frsize
        raise RingError(
            f"ring {name} needs {size / 2**20:.0f} MiB in {FOLDER} and {free / 2**20:.0f} MiB are free: "
            "take fewer slots, or enlarge it (a container has an option for its shared memory)"
        ) from error


def _map(file: int, geometry: Geometry) -> NDArray[np.uint8]:
    """The whole file, its pages present from the start: page faults would slow the first lap of a capture."""
    flags = mmap.MAP_SHARED | mmap.MAP_POPULATE
    return np.frombuffer(mmap.mmap(file, geometry.total_bytes, flags=flags), np.uint8)
