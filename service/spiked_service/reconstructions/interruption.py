"""What becomes of jobs whose worker died, or whose service ended while they ran."""

from dataclasses import replace
from datetime import UTC, datetime

from spiked_service.reconstructions.job_runner import queued_again
from spiked_service.reconstructions.queue_policy import QueuePolicy
from spiked_service.reconstructions.repository import ReconstructionRepository
from spiked_service.store.catalogue import Catalogue
from spiked_service.store.rows import JobState, ReconstructionRow


def requeue_interrupted(rows: ReconstructionRepository, adopted: bool) -> None:
    """Queue the jobs that an earlier service left running; they go on from their checkpoints or begin anew.

    Those on other machines are left to be `adopted`, if there is an executor for it.
    """
    for row in rows.interrupted():
        if row.attempt and adopted:
            continue
        if row.attempts >= QueuePolicy.MOST_ATTEMPTS:
            reason = (
                f"failed after {row.attempts} attempts, the last of which was interrupted by the death of the service"
            )
            rows.drop_checkpoint(row.id)
            rows.save(failed(row, reason))
            continue
        rows.save(queued_again(row, f"{_next_start(row, rows)}, because the service ended while it ran"))


def failed(row: ReconstructionRow, reason: str) -> ReconstructionRow:
    """The row of a job that fails now."""
    return replace(row, state=JobState.FAILED, reason=reason, ended_at=datetime.now(UTC), eta_s=None, attempt="")


def cancelled(row: ReconstructionRow) -> ReconstructionRow:
    """The row of a job that is cancelled while it waits."""
    return replace(row, state=JobState.CANCELLED, reason="", eta_s=None, ended_at=datetime.now(UTC))


def after_crash(
    row: ReconstructionRow,
    trouble: str,
    rows: ReconstructionRepository,
    catalogue: Catalogue,
    policy: QueuePolicy,
    *,
    begun: bool = True,
) -> ReconstructionRow:
    """The row of a job whose worker died: queued again while retries are left and there is a recording.

    One that was not `begun` has nothing to do with it: it is queued again, and that is no attempt.
    """
    row = replace(row, ended_at=datetime.now(UTC), eta_s=None, attempt="")
    capture = catalogue.captures.find(row.capture_id)
    again = capture is not None and (capture.plan.record or not row.task.reads_recording)
    if again and not begun:
        policy.postpone(row.id)
        return queued_again(replace(row, attempts=row.attempts - 1), trouble)
    if again and policy.retry(row.id):
        return queued_again(row, f"{trouble}; {_next_start(row, rows)} (attempt {row.attempts + 1})")
    rows.drop_checkpoint(row.id)
    tried = f", the last of {row.attempts} attempts" if row.attempts > 1 else ""
    return failed(row, f"{trouble}{tried}")


def _next_start(row: ReconstructionRow, rows: ReconstructionRepository) -> str:
    """How an interrupted job goes on, for users."""
    if rows.has_checkpoint(row.id):
        return "resumed from its checkpoint"
    return "restarted from the recording" if row.task.reads_recording else "restarted"
