"""What a recording is good for, from what its recorder saw; `spiked verify` looks at every byte."""

from spiked_service.messages import RecordingEnded
from spiked_service.store.rows import Grade, Judgement


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
