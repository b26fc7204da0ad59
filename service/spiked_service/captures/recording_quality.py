"""Quality of a recording from the report or the files of its recorder; `spiked verify` checks every byte."""

from collections import Counter
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from spiked.errors import IndexFileError, RecordingError
from spiked.recording import (
    LIVE,
    RecordingWriter,
    Recovered,
    Sidecar,
    index_path,
    recover,
    sidecar_path,
    write_sidecar,
)
from spiked.recording.sidecar import lost_by_cause
from spiked.ring import LossCause
from spiked.sensor import Sensor
from spiked_service.store.rows import Grade, Quality, Recorded
from spiked_service.workers.messages import RecordingEnded


def assess(report: RecordingEnded) -> Quality:
    """Quality from the report of the recorder, the worst reason first."""
    bad, degraded = [], []
    if report.frames == 0:
        bad.append("no frame was recorded")
    if report.dark:
        bad.append("no pixel ever fires")
    if report.saturated:
        bad.append("every pixel fires in every frame")
    if report.trouble:
        degraded.append(report.trouble)
    lost = sum(report.lost.values())
    if lost:
        causes = ", ".join(f"{cause} {count}" for cause, count in sorted(report.lost.items()))
        degraded.append(f"{lost} of {lost + report.frames} frames were lost ({causes})")
    if report.died:
        degraded.append("the acquisition died")
    grade = Grade.BAD if bad else Grade.DEGRADED if degraded else Grade.GOOD
    return Quality(grade, (*bad, *degraded))


def recover_and_assess(path: Path, why: str, sensor: Sensor | None = None) -> tuple[Recorded | None, Quality]:
    """Recover the recording of a recorder that died and assess it; `why` it died, for the user.

    A missing sidecar is written from `sensor`, if given.
    """
    if sensor is not None:
        with suppress(RecordingError):  # errors are reported below
            write_missing_sidecar(path, sensor)
    if not sidecar_path(path).exists():
        return None, Quality(Grade.BAD, ("no frame was recorded", why))
    try:
        found, problems = recovered(path)
    except RecordingError as error:
        return None, Quality(Grade.BAD, (str(error), why))
    causes = lost_by_cause(found.sidecar.gaps)
    lost = sum(causes.values())
    size = found.frames * found.sidecar.sensor().frame_bytes
    reasons = [*problems, *_missing(found), f"{why}; the recording holds its first {found.frames} frames"]
    if lost:
        reasons.append(f"{lost} of {lost + found.frames} frames were lost")
    if not found.frames:
        return Recorded(0, 0, lost=lost, lost_by_cause=causes), Quality(Grade.BAD, ("no frame was recorded", *reasons))
    return Recorded(found.frames, size, lost=lost, lost_by_cause=causes), Quality(Grade.DEGRADED, tuple(reasons))


def reassess(path: Path) -> tuple[Recorded, Quality, bool]:
    """Assess a recording from its sidecar and index; and whether its writer had finished it.

    The frames are not read. Raises RecordingError if the recording cannot be opened.
    """
    found, problems = recovered(path)
    causes = lost_by_cause(found.sidecar.gaps)
    lost = sum(causes.values())
    frame_bytes = found.sidecar.sensor().frame_bytes
    frames = min(found.frames, path.stat().st_size // frame_bytes)
    bad = [] if frames else ["no frame was recorded"]
    bad += _missing(found)
    if frames < found.frames:
        bad.append(f"the file ends after {frames} of the {found.frames} frames that its sidecar lists")
    if not found.was_finished:
        problems += (f"its recorder did not finish it; it holds its first {frames} frames",)
    if lost:
        problems += (f"{lost} of {lost + frames} frames were lost",)
    if not index_path(path).exists():
        problems += ("the index is missing, so its frames cannot be checked",)
    grade = Grade.BAD if bad else Grade.DEGRADED if problems else Grade.GOOD
    verdict = Quality(grade, (*bad, *problems))
    return Recorded(frames, frames * frame_bytes, lost=lost, lost_by_cause=causes), verdict, found.was_finished


def _missing(found: Recovered) -> list[str]:
    missing = found.missing_frames
    return (
        [f"{missing} frames after its first {found.frames} were on the disk and are not in the file"] if missing else []
    )


def recovered(path: Path) -> tuple[Recovered, tuple[str, ...]]:
    """Recover a recording, without its index if that is none; and the problems found. Raises RecordingError."""
    try:
        return recover(path, finish=True), ()
    except IndexFileError as error:
        problem = error
    try:
        index_path(path).rename(index_path(path).with_suffix(".index.unreadable"))
    except OSError as error:
        raise RecordingError(f"{index_path(path)}: cannot be renamed: {error.strerror}") from error
    return recover(path, finish=True), (str(problem),)


def write_missing_sidecar(path: Path, sensor: Sensor) -> bool:
    """Write a lost sidecar from the sensor of the capture; `recover` adds what the index holds.

    Recordings with an index are from recorders, which store compact frames. Return false if there is a sidecar, or no
    recording. Raises RecordingError.
    """
    beside = sidecar_path(path)
    if beside.exists() or not path.exists():
        return False
    try:
        stored = sensor.compact() if index_path(path).exists() else sensor
        write_sidecar(beside, Sidecar.of(stored, None, note="its sidecar was lost and rebuilt"))
    except OSError as error:
        raise RecordingError(f"{beside}: cannot be written: {error.strerror}") from error
    return True


def completed(path: Path, frames: int, recording: Recorded | None, verdict: Quality | None) -> tuple[Recorded, Quality]:
    """Recording and quality of a capture of `frames` frames, those lost before the ring included.

    Frames after the end of the recording count as lost to the disk, and are appended to the sidecar as a gap.
    """
    recording = recording or Recorded(0, 0)
    verdict = verdict or Quality(Grade.BAD, ("no frame was recorded",))
    missing = frames - recording.frames - recording.lost
    if missing <= 0:
        return recording, verdict
    with suppress(RecordingError), RecordingWriter.resume(path, durability=LIVE) as writer:
        writer.gap(writer.next_frame, missing, LossCause.DISK)
    grade = Grade.BAD if verdict.grade is Grade.BAD else Grade.DEGRADED
    reason = f"the last {missing} of {frames} frames were not recorded"
    causes = Counter(recording.lost_by_cause) + Counter({str(LossCause.DISK): missing})
    counted = replace(recording, lost=recording.lost + missing, lost_by_cause=dict(causes))
    return counted, Quality(grade, (*verdict.reasons, reason))
