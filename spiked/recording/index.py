"""The append-only file `NAME.index` beside `NAME.dat`: written, lost and synced frames, with checksums.

32 bytes of header (magic, version, bytes of a stored frame, CRC-32 of these), then 32 bytes an entry, little-endian:
i64 first frame, u32 count, u16 kind, u16 cause, i64 value, u32 CRC-32 of the frames as stored, u32 CRC-32 of the entry
up to here. Frames count from the recording's first, lost ones included. An entry is written after the frames that it
describes: however the writer stops, frames in the index are in the file; frames not in the index are not counted.
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

from spiked.errors import IndexFileError, RecordingError
from spiked.recording.sidecar import ClockPair, Gap

_HEADER = struct.Struct("<8sHHI12xI")
HEADER_BYTES = _HEADER.size
_ENTRY = struct.Struct("<qIHHqI")
_CHECK = struct.Struct("<I")
_MAGIC = b"SPIKEIDX"
_VERSION = 1
"""Of the format."""
ENTRY_BYTES = 32
"""Length of an entry."""
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
"""Codes 1 to 4. Another cause has code 0 here and keeps its name in the sidecar."""
_OTHER_CAUSE = "unknown"


class Kind(IntEnum):
    """Kind of an entry."""

    FRAMES = 1
    """`count` frames from `first` are at byte `value` and have this CRC."""
    GAP = 2
    """`count` frames from `first` are lost for this cause."""
    CLOCK = 3
    """Frame `first` arrived at Unix time `value`, ns."""
    SYNC = 4
    """The first `value` entries and their frames are synced to the disk."""


def index_path(recording: Path) -> Path:
    """Path of a recording's index."""
    return recording.with_suffix(".index")


class IndexWriter:
    """Appends entries, each with one write. Raises OSError on disk errors. Thread-safe."""

    def __init__(self, path: Path, frame_bytes: int, *, resume: bool = False) -> None:
        self._file = path.open("r+b" if resume else "xb", buffering=0)
        self._lock = threading.Lock()
        self.entries = 0
        """Number of entries."""
        if resume:
            self.entries = (self._file.seek(0, os.SEEK_END) - HEADER_BYTES) // ENTRY_BYTES
        else:
            head = _HEADER.pack(_MAGIC, _VERSION, ENTRY_BYTES, frame_bytes, 0)[:-4]
            self._file.write(head + _CHECK.pack(crc32(head)))

    def frames(self, first: int, count: int, offset: int, crc: int) -> None:
        """Append an entry of frames written at byte `offset`."""
        self._entry(first, count, Kind.FRAMES, 0, offset, crc)

    def gap(self, first: int, count: int, cause: str) -> None:
        """Append a gap, as several entries if it has 2^32 frames or more."""
        code = _CAUSES.index(cause) + 1 if cause in _CAUSES else 0
        while count:
            some = min(count, 0xFFFF_FFFF)
            self._entry(first, some, Kind.GAP, code, 0, 0)
            first, count = first + some, count - some

    def clock(self, frame: int, unix_ns: int) -> None:
        """Append a clock pair."""
        self._entry(frame, 0, Kind.CLOCK, 0, unix_ns, 0)

    def synced(self, entries: int) -> None:
        """Note that the first `entries` entries and their frames are synced to the disk."""
        self._entry(0, 0, Kind.SYNC, 0, entries, 0)

    def retract(self, entries: int) -> None:
        """Remove all entries but the first `entries`."""
        with self._lock:
            self._cut(entries)

    def fileno(self) -> int:
        """Descriptor, for syncing."""
        return self._file.fileno()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _entry(self, first: int, count: int, kind: Kind, cause: int, value: int, crc: int) -> None:
        entry = _ENTRY.pack(first, count, kind, cause, value, crc)
        with self._lock:
            if self._file.write(entry + _CHECK.pack(crc32(entry))) != ENTRY_BYTES:
                self._cut(self.entries)  # a full disk wrote a part: keep entries aligned
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            self.entries += 1

    def _cut(self, entries: int) -> None:
        end = HEADER_BYTES + entries * ENTRY_BYTES
        self._file.truncate(end)
        self._file.seek(end)
        self.entries = entries


@dataclass(frozen=True, eq=False)
class Index:
    """The entries of an index up to the first unreadable one."""

    frame_bytes: int
    entries: NDArray[np.void]
    """Structured array with the fields of an entry."""
    good_bytes: int
    """Length of the readable part of the file."""
    damaged_bytes: int
    """Bytes after it."""

    @property
    def blocks(self) -> NDArray[np.void]:
        """The entries of kind FRAMES."""
        return np.asarray(self.entries[self.entries["kind"] == Kind.FRAMES])

    @property
    def frames(self) -> int:
        """Number of stored frames."""
        return int(self.blocks["count"].sum())

    @property
    def unsynced(self) -> NDArray[np.intp]:
        """Indices of entries whose frames may not have been on the disk in a power failure."""
        kinds = self.entries["kind"]
        synced = int(self.entries["value"][kinds == Kind.SYNC].max(initial=0))
        blocks = np.flatnonzero(kinds == Kind.FRAMES)
        return blocks[blocks >= synced]

    def gaps(self) -> tuple[Gap, ...]:
        """The gaps in order."""
        lost = self.entries[self.entries["kind"] == Kind.GAP]
        return tuple(
            Gap(first=int(e["first"]), count=int(e["count"]), cause=([_OTHER_CAUSE, *_CAUSES])[int(e["cause"])])
            for e in lost
        )

    def clock(self) -> tuple[ClockPair, ...]:
        """The clock pairs in order."""
        pairs = self.entries[self.entries["kind"] == Kind.CLOCK]
        return tuple(ClockPair(frame=int(e["first"]), unix_ns=int(e["value"])) for e in pairs)


def read_index(path: Path) -> Index:
    """Read an index up to the first entry that is damaged or out of order.

    Raises RecordingError, and IndexFileError for a file that is no index.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise RecordingError(f"{path}: the index cannot be read: {error.strerror}") from error
    if len(content) < HEADER_BYTES:
        raise IndexFileError(f"{path}: the index has no header; remove the file to read the recording without it")
    magic, version, entry_bytes, frame_bytes, check = _HEADER.unpack_from(content)
    if magic != _MAGIC or check != crc32(content[: HEADER_BYTES - 4]) or entry_bytes != ENTRY_BYTES:
        raise IndexFileError(f"{path}: this is not an index of a recording, or its header is damaged")
    if version != _VERSION:
        raise RecordingError(
            f"{path}: an index of version {version}; this spiked reads version {_VERSION}: use a newer spiked"
        )
    whole = (len(content) - HEADER_BYTES) // ENTRY_BYTES
    entries = np.frombuffer(content, _DTYPE, whole, HEADER_BYTES)
    good = _good(entries, content, frame_bytes)
    good_bytes = HEADER_BYTES + good * ENTRY_BYTES
    return Index(frame_bytes, entries[:good], good_bytes, len(content) - good_bytes)


def _good(entries: NDArray[np.void], content: bytes, frame_bytes: int) -> int:
    """Number of entries before the first that is damaged or inconsistent with the entries before it."""
    view = memoryview(content)
    for number in range(len(entries)):
        start = HEADER_BYTES + number * ENTRY_BYTES
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
