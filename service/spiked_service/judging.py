"""What a recording is good for, from what its recorder saw or left behind; `spiked verify` looks at every byte."""

from pathlib import Path

from spiked.errors import RecordingError
from spiked.recording import recover, sidecar_path
from spiked_service.messages import RecordingEnded
from spiked_service.store.rows import Grade, Judgement, Recorded


def judged(account: RecordingEnded) -> Judgement:
    """The verdict, with the worst reason first."""
    bad, degraded = [], []
    if account.frames == 0:
        bad.append("no frame was recorded")
    if account.dark:
        bad.append("no pixel ever fires")
    if account.saturated:
        bad.append("every pixel fires in every frame")
    if account.trouble:
        degraded.append(account.trouble)
    lost = sum(account.lost.values())
    if lost:
        causes = ", ".join(f"{cause} {count}" for cause, count in sorted(account.lost.items()))
        degraded.append(f"{lost} of {lost + account.frames} frames were lost ({causes})")
    if account.died:
        degraded.append("the acquisition died")
    grade = Grade.BAD if bad else Grade.DEGRADED if degraded else Grade.GOOD
    return Judgement(grade, (*bad, *degraded))


def salvaged(path: Path, why: str) -> tuple[Recorded | None, Judgement]:
    """Make whole what a recorder left that died for good, and judge it; `why` it ended, for people."""
    if not sidecar_path(path).exists():
        return None, Judgement(Grade.BAD, ("no frame was recorded", why))
    try:
        found = recover(path, finish=True)
    except RecordingError as error:
        return None, Judgement(Grade.BAD, (str(error), why))
    lost = sum(gap.count for gap in found.sidecar.gaps)
    size = found.frames * found.sidecar.sensor().frame_bytes
    reasons = [f"{why}; the recording holds its first {found.frames} frames"]
    if lost:
        reasons.append(f"{lost} of {lost + found.frames} frames were lost")
    if not found.frames:
        return Recorded(0, 0), Judgement(Grade.BAD, ("no frame was recorded", *reasons))
    return Recorded(found.frames, size, lost=lost), Judgement(Grade.DEGRADED, tuple(reasons))
