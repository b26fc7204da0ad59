"""Checks a recording in one pass over all its frames."""

import os
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from spiked.errors import RecordingError
from spiked.recording.geometry import RecordingGeometry, tags_agree
from spiked.recording.index import index_path, read_index
from spiked.recording.reader import Recording, open_unchecked
from spiked.recording.recover import damaged_blocks
from spiked.sensor import BitOrder, Intrinsics, Layout, Mosaic, Response

_CHUNK_BYTES = 4 << 20
"""Bytes read at a time."""


class Verdict(StrEnum):
    """Grade of a recording."""

    GOOD = "good"
    DEGRADED = "degraded"
    """Usable, with missing or damaged parts."""
    BAD = "bad"
    """Contradicts its sidecar, or has no information."""


@dataclass(frozen=True)
class Verification:
    """Result of `verify`."""

    recording: Recording
    verdict: Verdict
    reasons: tuple[str, ...]
    """Why the grade is not good, one sentence each, the worst first."""
    spikes: int
    spike_rate: float
    """Mean spikes per pixel and frame."""
    wrong_tags: int | None
    """Frames with wrong row numbers; None if the layout has none."""
    dead_rows: tuple[int, ...]
    """Rows of the upright image in which no pixel ever fires."""
    stuck_rows: tuple[int, ...]
    """Rows of the upright image in which every pixel fires in every frame."""


def verify(
    path: str | os.PathLike[str],
    *,
    width: int | None = None,
    height: int | None = None,
    frame_rate_hz: float | None = None,
    layout: Layout | None = None,
    bit_order: BitOrder | None = None,
    flipped: bool | None = None,
    mosaic: Mosaic | None = None,
    intrinsics: Intrinsics | None = None,
    response: Response | None = None,
) -> Verification:
    """Check every frame of a recording. The arguments are those of `open_recording`.

    A file that contradicts its sidecar or has wrong row numbers is bad. Raises RecordingError for a file that cannot be
    read as a recording at all.
    """
    given = RecordingGeometry(width, height, frame_rate_hz, layout, bit_order, flipped, mosaic, intrinsics, response)
    recording = open_unchecked(Path(path), given)
    scan = _scan(recording)
    sensor = recording.sensor
    rate = scan.spikes / (recording.frames * sensor.width * sensor.height)

    bad, degraded = list(recording.contradictions), list(recording.warnings)
    if scan.wrong_tags:
        bad.append(f"{scan.wrong_tags} of {recording.frames} frames have wrong row numbers")
    if rate in (0.0, 1.0):
        bad.append("no pixel ever fires" if rate == 0 else "every pixel fires in every frame")
    elif scan.dead_rows or scan.stuck_rows:
        degraded += _rows("never fire", scan.dead_rows) + _rows("always fire", scan.stuck_rows)
    degraded += _index_problems(recording)
    if recording.gaps:
        lost = sum(gap.count for gap in recording.gaps)
        degraded.append(f"{lost} frames were lost in {len(recording.gaps)} gaps")
    verdict = Verdict.BAD if bad else Verdict.DEGRADED if degraded else Verdict.GOOD
    return Verification(
        recording,
        verdict,
        (*bad, *degraded),
        scan.spikes,
        rate,
        scan.wrong_tags,
        scan.dead_rows,
        scan.stuck_rows,
    )


def _index_problems(recording: Recording) -> list[str]:
    """Errors found with the checksums, if the recording has an index."""
    if not index_path(recording.path).exists():
        return []
    try:
        index = read_index(index_path(recording.path))
        damaged = damaged_blocks(recording.path, index)
    except RecordingError as error:
        return [str(error)]
    problems = []
    if damaged:
        lost = sum(block.count for block in damaged)
        problems.append(f"{lost} frames differ from what was written, the first at frame {damaged[0].first}")
    if index.damaged_bytes:
        problems.append(f"the last {index.damaged_bytes} bytes of its index are damaged")
    if index.frames != recording.frames:
        problems.append(f"its index has {index.frames} frames, the file {recording.frames}")
    return problems


def _rows(what: str, rows: tuple[int, ...]) -> list[str]:
    shown = ", ".join(map(str, rows[:5])) + (", ..." if len(rows) > 5 else "")
    return [f"{len(rows)} rows {what}: {shown}"] if rows else []


@dataclass(frozen=True)
class _Scan:
    spikes: int
    wrong_tags: int | None
    dead_rows: tuple[int, ...]
    stuck_rows: tuple[int, ...]


def _scan(recording: Recording) -> _Scan:
    sensor = recording.sensor
    tagged = sensor.layout is Layout.ROW_TAGGED
    some = np.zeros(sensor.height * sensor.row_bytes, np.uint8)
    every = np.full_like(some, 0xFF)
    spikes = wrong = 0
    for first, stored in recording.chunks(max(1, _CHUNK_BYTES // sensor.frame_bytes)):
        if tagged:
            wrong += int((~tags_agree(stored, sensor.height, sensor.row_bytes)).sum())
        frames = recording.compact(first, len(stored))
        spikes += int.from_bytes(frames.tobytes()).bit_count()
        some |= np.bitwise_or.reduce(frames, axis=0)
        every &= np.bitwise_and.reduce(frames, axis=0)
    dead = (some.reshape(sensor.height, -1) == 0).all(axis=1)
    stuck = (every.reshape(sensor.height, -1) == 0xFF).all(axis=1)
    return _Scan(spikes, wrong if tagged else None, _upright(dead, recording), _upright(stuck, recording))


def _upright(rows: NDArray[np.bool_], recording: Recording) -> tuple[int, ...]:
    if recording.sensor.flipped:
        rows = rows[::-1]
    return tuple(int(row) for row in np.flatnonzero(rows))
