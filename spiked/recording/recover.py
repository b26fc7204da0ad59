"""Recovers an unfinished recording: keeps its complete blocks and cuts off the rest."""

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from isal.isal_zlib import crc32

from spiked.errors import IndexFileError, RecordingError
from spiked.recording.index import Index, Kind, index_path, read_index
from spiked.recording.sidecar import Gap, Sidecar, read_sidecar, sidecar_path, write_sidecar


@dataclass(frozen=True)
class Recovered:
    """Result of recovering a recording."""

    sidecar: Sidecar
    """The sidecar, with the gaps and clock pairs of the index."""
    frames: int
    dropped_bytes: int
    """Bytes cut off after them."""
    was_finished: bool
    """The recording was finished; nothing was changed."""
    missing_frames: int = 0
    """Frames that the index says were on the disk, and that are not in the file."""


def recover(path: Path, *, finish: bool = False) -> Recovered:
    """Cut the recording of a dead writer after its last complete block; with `finish`, complete its sidecar.

    Blocks that were not synced are compared with their checksums. Without an index, whole frames are kept. Must not be
    called while a writer is alive. Raises RecordingError for a file without a sidecar, or if it cannot be changed, and
    IndexFileError for an index that cannot be used.
    """
    missing = 0
    sidecar = read_sidecar(sidecar_path(path))
    frame_bytes = sidecar.sensor().frame_bytes
    try:
        size = path.stat().st_size
        if sidecar.frames is not None:
            return Recovered(sidecar, sidecar.frames, 0, was_finished=True)
        if index_path(path).exists():
            kept, missing = _by_index(path, read_index(index_path(path)), frame_bytes)
            frames = kept.frames
            sidecar = sidecar.model_copy(update={"gaps": kept.gaps(), "clock": kept.clock()})
        else:
            frames = size // frame_bytes
        os.truncate(path, frames * frame_bytes)
        if finish:
            _sync(path)
            sidecar = sidecar.model_copy(update={"frames": frames})
            write_sidecar(sidecar_path(path), sidecar)
    except OSError as error:
        raise RecordingError(f"{path}: the recording cannot be recovered: {error.strerror}") from error
    return Recovered(sidecar, frames, size - frames * frame_bytes, was_finished=False, missing_frames=missing)


def damaged_blocks(path: Path, blocks: Index) -> list[Gap]:
    """Blocks whose frames differ from their checksums, as gaps of cause disk."""
    with path.open("rb") as file:
        return [
            Gap(first=int(entry["first"]), count=int(entry["count"]), cause="disk")
            for entry in blocks.blocks
            if not _whole(file.fileno(), int(entry["value"]), int(entry["count"]) * blocks.frame_bytes, entry["crc"])
        ]


def _by_index(path: Path, index: Index, frame_bytes: int) -> tuple[Index, int]:
    """The index up to the last block that is whole in the file, to which it is cut; and the synced frames after it."""
    if index.frame_bytes != frame_bytes:
        raise IndexFileError(
            f"{index_path(path)}: its frames have {index.frame_bytes} bytes, those of the sidecar {frame_bytes}; "
            "it belongs to another recording: remove it"
        )
    good, unsynced = len(index.entries), index.unsynced
    blocks = np.flatnonzero(index.entries["kind"] == Kind.FRAMES)
    counts = index.entries["count"][blocks].astype(np.int64)
    beyond = blocks[np.cumsum(counts) * frame_bytes > path.stat().st_size]
    if len(beyond):  # the file was copied before its index, or the disk has lost what it had
        good = int(beyond[0])
    with path.open("rb") as file:
        for number in unsynced[unsynced < good]:
            entry = index.entries[number]
            offset, length = int(entry["value"]), int(entry["count"]) * frame_bytes
            if not _whole(file.fileno(), offset, length, int(entry["crc"])):
                good = int(number)
                break
    entries = index.entries[:good]
    kept = Index(frame_bytes, entries, index.good_bytes - (len(index.entries) - good) * entries.itemsize, 0)
    os.truncate(index_path(path), kept.good_bytes)
    return kept, int(counts[(blocks >= good) & ~np.isin(blocks, unsynced)].sum())


def _whole(file: int, offset: int, length: int, crc: int) -> bool:
    content = os.pread(file, length, offset)
    return len(content) == length and crc32(content) == crc


def _sync(path: Path) -> None:
    file = os.open(path, os.O_RDWR)
    try:
        os.fsync(file)
    finally:
        os.close(file)
