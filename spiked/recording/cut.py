"""A range of a recording as a recording of its own, with the same bits."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from spiked.errors import RecordingError
from spiked.recording.durability import PLAIN, Durability
from spiked.recording.index import index_path, read_index
from spiked.recording.reader import Recording
from spiked.recording.recover import damaged_blocks
from spiked.recording.sidecar import ClockPair, Gap, read_sidecar, sidecar_path
from spiked.recording.writer import whole_recording

__all__ = ["cut_recording"]

BLOCK_FRAMES = 64
"""Frames that are copied at a time, and of an entry of the index."""


def cut_recording(recording: Recording, out: Path, begin: int, end: int) -> tuple[int, int]:
    """Write frames `begin` to `end`, exclusive, to a new file with its sidecar, and an index if the recording has one.

    Frames count from the recording's first, lost ones included, as gaps and clock pairs do; what was lost within the
    range is a gap of the new file. Returns the numbers of frames and of lost frames. Raises RecordingError for a range
    that holds no frame or reaches beyond the recording, for frames that differ from their checksums, and for a file
    that cannot be written.
    """
    last = recording.capture_index(recording.frames - 1) + 1
    if not 0 <= begin < end <= last:
        raise RecordingError(
            f"{recording.path}: {begin}:{end} is no range of its frames, which are 0:{last}; the end is exclusive"
        )
    gaps = [part for gap in sorted(recording.gaps, key=lambda gap: gap.first) for part in _within(gap, begin, end)]
    lost = sum(gap.count for gap in gaps)
    if lost == end - begin:
        raise RecordingError(f"{recording.path}: all frames of {begin}:{end} were lost; choose another range")
    indexed = index_path(recording.path).exists()
    if indexed:
        _check(recording, begin, end)
    durability = Durability(index=True) if indexed else PLAIN
    with whole_recording(out, recording.sensor, durability=durability, **_fields(recording, out, begin)) as writer:
        for pair in _clock(recording, begin, end):
            writer.clock_pair(pair.frame, pair.unix_ns)
        row = begin - sum(min(gap.count, max(0, begin - gap.first)) for gap in recording.gaps)
        for stored, gap in _pieces(gaps, end - begin):
            for start in range(row, row + stored, BLOCK_FRAMES):
                writer.append(recording.compact(start, min(BLOCK_FRAMES, row + stored - start)))
            row += stored
            if gap is not None:
                writer.gap(gap.first, gap.count, gap.cause)
    return writer.frames, lost


def _within(gap: Gap, begin: int, end: int) -> list[Gap]:
    """The part of a gap in a range, counted from its begin."""
    first, stop = max(gap.first, begin), min(gap.first + gap.count, end)
    return [] if first >= stop else [gap.model_copy(update={"first": first - begin, "count": stop - first})]


def _pieces(gaps: list[Gap], frames: int) -> Iterator[tuple[int, Gap | None]]:
    """Numbers of stored frames, and the gap after them; None after the last."""
    next_frame = 0
    for gap in gaps:
        yield gap.first - next_frame, gap
        next_frame = gap.first + gap.count
    yield frames - next_frame, None


def _check(recording: Recording, begin: int, end: int) -> None:
    """Raises RecordingError if frames of the range differ from their checksums: the copy would have valid ones."""
    for block in damaged_blocks(recording.path, read_index(index_path(recording.path))):
        if _within(block, begin, end):
            raise RecordingError(
                f"{recording.path}: frames {block.first}:{block.first + block.count} differ from their checksum; "
                "cut a range beside them"
            )


def _clock(recording: Recording, begin: int, end: int) -> list[ClockPair]:
    """The clock pairs of a range; the times of its ends if there are fewer than two."""
    pairs = [pair for pair in recording.clock if begin <= pair.frame < end]
    if recording.clock and len(pairs) < 2:
        ends = sorted({begin, end - 1})
        pairs = [
            ClockPair(frame=frame, unix_ns=int(at)) for frame, at in zip(ends, recording.unix_ns(ends), strict=True)
        ]
    return [ClockPair(frame=pair.frame - begin, unix_ns=pair.unix_ns) for pair in pairs]


def _fields(recording: Recording, out: Path, begin: int) -> dict[str, Any]:
    """The fields of the sidecar that are not of the sensor; the calibration stays where it is."""
    beside = sidecar_path(recording.path)
    if not beside.exists():
        return {"first_frame": begin, "assumed": recording.assumed}
    sidecar = read_sidecar(beside)
    fields: dict[str, Any] = dict(sidecar.model_extra or {})
    fields |= {"note": sidecar.note, "first_frame": sidecar.first_frame + begin, "assumed": recording.assumed}
    fields |= {"device": sidecar.device, "profile": sidecar.profile}
    if sidecar.calibration is not None:
        fields["calibration"] = os.path.relpath((beside.parent / sidecar.calibration).resolve(), out.resolve().parent)
    return fields
