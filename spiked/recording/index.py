"""The append-only file `NAME.index` beside `NAME.dat`: which frames were written, lost and synced, with checksums.

32 bytes of header (magic, version, bytes of a stored frame, CRC-32 of these), then 32 bytes an entry, little-endian:
i64 first frame, u32 count, u16 kind, u16 cause, i64 value, u32 CRC-32 of the frames as stored, u32 CRC-32 of the entry
up to here. Frames count from the recording's first, lost ones included. An entry is written after what it tells of, so
whatever stops the writer, what the index tells of is there; what it does not tell of yet is not counted.
"""

import errno
import os
import struct
import threading
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path

import numpy as np
from isal.isal_zlib import crc32
from numpy.typing import NDArray

from spiked.errors import RecordingError
from spiked.recording.sidecar import ClockPair, Gap

_HEADER = struct.Struct("<8sHHI12xI")
_ENTRY = struct.Struct("<qIHHqI")
_CHECK = struct.Struct("<I")
_MAGIC = b"SPIKEIDX"
_VERSION = 1
ENTRY_BYTES = 32
_DTYPE = np.dtype(
    [
        ("first", "<i8"),
        ("count", "<u4"),
        ("kind", "<u2"),
        ("cause", "<u2"),
        ("value", "<i8"),
        ("crc", "<u4"),
        ("check", "<u4"),
    ]
)
_CAUSES = ("device", "usb", "ring", "disk")
"""By number from 1; a cause of another name is 0 here and keeps its name in the sidecar."""
_OTHER_CAUSE = "unknown"


class Kind(IntEnum):
    """What an entry tells of."""

    FRAMES = 1
    """`count` frames from `first` lie at byte `value` and have this CRC."""
    GAP = 2
    """`count` frames from `first` are lost by this cause."""
    CLOCK = 3
    """The host's clock was `value` (nanoseconds since 1970) when frame `first` came."""
    SYNC = 4
    """The first `value` entries, and what they tell of, are on the disk itself, not only with the kernel."""


def index_path(recording: Path) -> Path:
    """Where the index of a recording is."""
    return recording.with_suffix(".index")


class IndexWriter:
    """Appends entries; each is one write to the kernel. Errors of the disk are OSErrors. Used by any thread."""

    def __init__(self, path: Path, frame_bytes: int, *, resume: bool = False) -> None:
        self._file = path.open("r+b" if resume else "xb", buffering=0)
        self._lock = threading.Lock()
        self.entries = 0
        """How many there are."""
        if resume:
            self.entries = (self._file.seek(0, os.SEEK_END) - _HEADER.size) // ENTRY_BYTES
        else:
            head = _HEADER.pack(_MAGIC, _VERSION, ENTRY_BYTES, frame_bytes, 0)[:-4]
            self._file.write(head + _CHECK.pack(crc32(head)))

    def frames(self, first: int, count: int, offset: int, crc: int) -> None:
        """Frames that were written at this byte."""
        self._entry(first, count, Kind.FRAMES, 0, offset, crc)

    def gap(self, first: int, count: int, cause: str) -> None:
        """Frames that are lost; one entry tells of up to 2^32 - 1."""
        code = _CAUSES.index(cause) + 1 if cause in _CAUSES else 0
        while count:
            some = min(count, 0xFFFF_FFFF)
            self._entry(first, some, Kind.GAP, code, 0, 0)
            first, count = first + some, count - some

    def clock(self, frame: int, unix_ns: int) -> None:
        """The host's clock when a frame came."""
        self._entry(frame, 0, Kind.CLOCK, 0, unix_ns, 0)

    def synced(self, entries: int) -> None:
        """So many entries, and what they tell of, are on the disk itself."""
        self._entry(0, 0, Kind.SYNC, 0, entries, 0)

    def retract(self, entries: int) -> None:
        """Take back all entries but the first so many."""
        with self._lock:
            self._cut(entries)

    def fileno(self) -> int:
        """Its descriptor, for syncing."""
        return self._file.fileno()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _entry(self, first: int, count: int, kind: Kind, cause: int, value: int, crc: int) -> None:
        entry = _ENTRY.pack(first, count, kind, cause, value, crc)
        with self._lock:
            if self._file.write(entry + _CHECK.pack(crc32(entry))) != ENTRY_BYTES:
                self._cut(self.entries)  # a full disk took a part: entries stay aligned
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            self.entries += 1

    def _cut(self, entries: int) -> None:
        end = _HEADER.size + entries * ENTRY_BYTES
        self._file.truncate(end)
        self._file.seek(end)
        self.entries = entries


@dataclass(frozen=True, eq=False)
class Index:
    """What an index tells, up to its first unreadable entry."""

    frame_bytes: int
    entries: NDArray[np.void]
    """Structured array with the fields of an entry."""
    good_bytes: int
    """Length of the readable part of the file."""
    damaged_bytes: int
    """What follows it."""

    @property
    def blocks(self) -> NDArray[np.void]:
        """The entries of frames."""
        return np.asarray(self.entries[self.entries["kind"] == Kind.FRAMES])

    @property
    def frames(self) -> int:
        """Frames it tells of, lost ones not counted."""
        return int(self.blocks["count"].sum())

    @property
    def unsynced(self) -> NDArray[np.intp]:
        """Which entries are of frames that may not have been on the disk itself when the machine lost its power."""
        kinds = self.entries["kind"]
        synced = int(self.entries["value"][kinds == Kind.SYNC].max(initial=0))
        blocks = np.flatnonzero(kinds == Kind.FRAMES)
        return blocks[blocks >= synced]

    def gaps(self) -> tuple[Gap, ...]:
        """The losses, in order."""
        lost = self.entries[self.entries["kind"] == Kind.GAP]
        return tuple(
            Gap(first=int(e["first"]), count=int(e["count"]), cause=([_OTHER_CAUSE, *_CAUSES])[int(e["cause"])])
            for e in lost
        )

    def clock(self) -> tuple[ClockPair, ...]:
        """The pairs of frame and clock, in order."""
        pairs = self.entries[self.entries["kind"] == Kind.CLOCK]
        return tuple(ClockPair(frame=int(e["first"]), unix_ns=int(e["value"])) for e in pairs)


def read_index(path: Path) -> Index:
    """Read an index up to its first entry that is damaged or out of order. Raises RecordingError."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise RecordingError(f"{path}: the index cannot be read: {error.strerror}") from error
    if len(content) < _HEADER.size:
        raise RecordingError(f"{path}: the index has no header; remove it to do without")
    magic, version, entry_bytes, frame_bytes, check = _HEADER.unpack_from(content)
    if magic != _MAGIC or check != crc32(content[: _HEADER.size - 4]) or entry_bytes != ENTRY_BYTES:
        raise RecordingError(f"{path}: this is not an index of a recording, or its header is damaged")
    if version != _VERSION:
        raise RecordingError(f"{path}: an index of version {version}, this spiked knows {_VERSION}: take a newer one")
    whole = (len(content) - _HEADER.size) // ENTRY_BYTES
    entries = np.frombuffer(content, _DTYPE, whole, _HEADER.size)
    good = _good(entries, content, frame_bytes)
    good_bytes = _HEADER.size + good * ENTRY_BYTES
    return Index(frame_bytes, entries[:good], good_bytes, len(content) - good_bytes)


def _good(entries: NDArray[np.void], content: bytes, frame_bytes: int) -> int:
    """Number of entries before the first that is damaged or does not follow from those before it."""
    view = memoryview(content)
    for number in range(len(entries)):
        start = _HEADER.size + number * ENTRY_BYTES
        if crc32(view[start : start + ENTRY_BYTES - 4]) != entries["check"][number]:
            entries = entries[:number]
            break
    kinds = entries["kind"]
    advances = np.where((kinds == Kind.FRAMES) | (kinds == Kind.GAP), entries["count"], 0).astype(np.int64)
    before = np.concatenate([[0], np.cumsum(advances)[:-1]])
    stored = np.where(kinds == Kind.FRAMES, entries["count"], 0).astype(np.int64)
    offsets = np.concatenate([[0], np.cumsum(stored)[:-1]]) * frame_bytes
    follows = (
        np.isin(kinds, list(Kind))
        & ((advances == 0) | (entries["first"] == before))
        & ((kinds != Kind.FRAMES) | (entries["value"] == offsets))
        & (entries["cause"] <= len(_CAUSES))
    )[: len(entries)]
    wrong = np.flatnonzero(~follows)
    return int(wrong[0]) if len(wrong) else len(entries)
