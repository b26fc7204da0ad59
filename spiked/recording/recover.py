"""Recovers an unfinished recording: keeps its complete blocks and cuts off the rest."""

import os
from dataclasses import dataclass
from pathlib import Path

from isal.isal_zlib import crc32

from spiked.errors import RecordingError
from spiked.recording.index import Index, index_path, read_index
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


def recover(path: Path, *, finish: bool = False) -> Recovered:
    """Cut the recording of a dead writer after its last complete block; with `finish`, complete its sidecar.

    Blocks that were not synced are compared with their checksums. Without an index, whole frames are kept. Must not be
    called while a writer is alive. Raises RecordingError for a file without a sidecar, or if it cannot be changed.
    """
    sidecar = read_sidecar(sidecar_path(path))
    frame_bytes = sidecar.sensor().frame_bytes
    try:
        size = path.stat().st_size
        if sidecar.frames is not None:
            return Recovered(sidecar, sidecar.frames, 0, was_finished=True)
        if index_path(path).exists():
            frames, gaps, clock = _by_index(path, read_index(index_path(path)), frame_bytes)
            sidecar = sidecar.model_copy(update={"gaps": gaps, "clock": clock})
        else:
            frames = size // frame_bytes
        os.truncate(path, frames * frame_bytes)
        if finish:
            _sync(path)
            sidecar = sidecar.model_copy(update={"frames": frames})
            write_sidecar(sidecar_path(path), sidecar)
    except OSError as error:
        raise RecordingError(f"{path}: the recording cannot be recovered: {error.strerror}") from error
    return Recovered(sidecar, frames, size - frames * frame_bytes, was_finished=False)


def damaged_blocks(path: Path, blocks: Index) -> list[Gap]:
    """Blocks whose frames differ from their checksums, as gaps of cause disk."""
    with path.open("rb") as file:
        return [
            Gap(first=int(entry["first"]), count=int(entry["count"]), cause="disk")
            for entry in blocks.blocks
            if not _whole(file.fileno(), int(entry["value"]), int(entry["count"]) * blocks.frame_bytes, entry["crc"])
        ]


def _by_index(path: Path, index: Index, frame_bytes: int) -> tuple[int, tuple[Gap, ...], tuple[object, ...]]:
    if index.frame_bytes != frame_bytes:
        raise RecordingError(
            f"{index_path(path)}: its frames have {index.frame_bytes} bytes, those of the sidecar {frame_bytes}; "
            "it belongs to another recording: remove it"
        )
    good = len(index.entries)
    size = path.stat().st_size
    with path.open("rb") as file:
        for number in index.unsynced:
            entry = index.entries[number]
            offset, length = int(entry["value"]), int(entry["count"]) * frame_bytes
            if offset + length > size or not _whole(file.fileno(), offset, length, int(entry["crc"])):
                good = int(number)
                break
    entries = index.entries[:good]
    kept = Index(frame_bytes, entries, index.good_bytes - (len(index.entries) - good) * entries.itemsize, 0)
    os.truncate(index_path(path), kept.good_bytes)
    return kept.frames, kept.gaps(), kept.clock()


def _whole(file: int, offset: int, length: int, crc: int) -> bool:
    content = os.pread(file, length, offset)
    return len(content) == length and crc32(content) == crc


def _sync(path: Path) -> None:
    file = os.open(path, os.O_RDWR)
    try:
        os.fsync(file)
    finally:
        os.close(file)
