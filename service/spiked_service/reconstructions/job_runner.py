"""Runs one reconstruction in a worker process.

Where it runs is the business of an `Executor`.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime

from spiked.recon import State
from spiked_service.reconstructions.executor import Executor, Worker
from spiked_service.reconstructions.notifier import Notifier
from spiked_service.reconstructions.repository import ReconstructionRepository
from spiked_service.settings.reconstruction_options import ReconstructionOptions
from spiked_service.store.rows import JobState, ReconstructionRow, Stage, Task
from spiked_service.workers.messages import (
    FramesSkipped,
    JobCommand,
    NodeFound,
    NotBegun,
    PlaceCompared,
    PoseEstimated,
    ReconstructionStatus,
    VersionPublished,
    WorkerError,
    WorkerEvent,
)
from spiked_service.workers.process import StandbyWorker

_SAVE_S = 5.0
"""Interval at which the row of a running job is saved; changes of stage or version are saved at once."""


class JobRunner:
    """A reconstruction with its worker: applies the events of the worker to the row and determines the outcome.

    Events and the exit arrive on one thread of the worker. `cancel`, `finish_early`, `hold`, `dismiss` and `kill_after`
    may be called from any thread.
    """

    def __init__(
        self,
        row: ReconstructionRow,
        executor: Executor,
        rows: ReconstructionRepository,
        notifier: Notifier,
        must_yield: Callable[[ReconstructionRow], bool],
        on_exit: Callable[["JobRunner", str | None], None],
    ) -> None:
        """`must_yield` decides at the start of the refinement whether the job returns to the queue.

        `on_exit` is called once, with the reason as a sentence if the worker failed.
        """
        self.row = row
        """The newest row."""
        self.not_begun = False
        """Whether no machine has begun the attempt, for a reason that is not the job's."""
        self._executor = executor
        self._rows = rows
        self._notifier = notifier
        self._must_yield = must_yield
        self._on_exit = on_exit
        self._worker: Worker | None = None
        self._cancelled = False
        self._early = False
        self._held = False
        self._yielded = False
        self._error: str | None = None
        self._mismatch = ""
        """Why map and recording, or two maps, do not show one place."""
        self._frames_skipped: FramesSkipped | None = None
        self._again_of: int | None = None
        self._saved_s = time.monotonic()

    @property
    def pid(self) -> int | None:
        """Process id of the worker, None before it runs."""
        return None if self._worker is None else self._worker.pid

    def start(self, command: JobCommand, standby: StandbyWorker | None) -> None:
        """Save the row and start the worker, or use a standby worker. Raises OSError."""
        command.folder.mkdir(exist_ok=True)
        self.row = self._rows.save(replace(self.row, attempt=self._executor.attempt(), node=""))
        self._worker = self._executor.start(self.row, command, self._handle, self._exited, standby)

    def adopt(self, command: JobCommand) -> None:
        """Follow the worker of a job that an earlier service has started elsewhere."""
        self._rows.update(self.row)
        self._worker = self._executor.adopt(self.row, command, self._handle, self._exited)

    def cancel(self) -> None:
        """Stop the worker; published versions are kept."""
        self._cancelled = True
        if self.row.task.reconstructs:
            if self._worker is not None:
                self._worker.cancel()
        else:
            self.dismiss()  # it publishes at its end only

    def finish_early(self) -> None:
        """End the refinement; the reconstruction counts as complete."""
        self._early = True
        self._stop()

    def hold(self) -> None:
        """Stop the worker for now: the job returns to the queue, held there, and goes on from its checkpoint."""
        self._held = True
        self.dismiss()

    def dismiss(self) -> None:
        """Ask the worker to exit at once."""
        if self._worker is not None:
            self._worker.dismiss()

    def detach(self) -> None:
        """The service ends: a worker on this machine exits at once, others go on."""
        if self._worker is not None:
            self._worker.detach()

    def kill_after(self, timeout_s: float) -> None:
        """Wait for the worker to exit; kill it after `timeout_s`."""
        if self._worker is not None:
            self._worker.kill_after(timeout_s)

    def outcome(self, trouble: str | None) -> ReconstructionRow | None:
        """The row after the exit: over, or queued again from the recording; None if the worker died unexpectedly."""
        row = replace(self.row, ended_at=datetime.now(UTC), eta_s=None, attempt="")
        if self._cancelled:
            return replace(row, state=JobState.CANCELLED, stage=Stage.DONE if trouble is None else row.stage, reason="")
        if self._held and not (trouble is None and row.stage is Stage.DONE):
            held = replace(row, held=True, attempts=row.attempts - 1)
            return replace(queued_again(held, ""), progress=row.progress)
        if trouble is not None:
            return None if self._error is None else replace(row, state=JobState.FAILED, reason=self._error)
        if self._frames_skipped is not None and not self._early:
            seen, skipped = self._frames_skipped.frames, self._frames_skipped.skipped
            reason = f"{skipped} of {seen} frames were skipped live; restarted from the recording with all of them"
            return queued_again(row, reason)
        if self._yielded and row.progress < 1 and not self._early:
            return queued_again(row, "")
        if row.recognised is False:
            return replace(row, state=JobState.FAILED, stage=Stage.DONE, reason=self._not_one_place())
        if not row.frames and row.task.reads_recording:
            reason = "no frames were received, so there is nothing to reconstruct"
            return replace(row, state=JobState.CANCELLED, stage=Stage.DONE, reason=reason)
        if not row.poses:
            return replace(row, state=JobState.FAILED, stage=Stage.DONE, reason=row.reason or "no path was found")
        progress = row.progress if self._early else 1.0
        return replace(row, state=JobState.COMPLETE, stage=Stage.DONE, progress=progress, reason=self._remarks())

    def _stop(self) -> None:
        if self._worker is not None:
            self._worker.stop()

    def _exited(self, trouble: str | None) -> None:
        self._on_exit(self, trouble)

    def _handle(self, event: WorkerEvent) -> None:
        match event:
            case NodeFound():
                self.row = replace(self.row, node=event.node)
                self._save()
            case NotBegun():
                self.not_begun = True
            case ReconstructionStatus():
                self._advance(event)
            case PoseEstimated():
                self._notifier.pose(self.row, event.pose)
            case VersionPublished():
                self._publish(event)
            case FramesSkipped():
                self._frames_skipped = event
            case PlaceCompared():
                self.row = replace(self.row, recognised=event.recognised)
                self._mismatch = event.reason
            case WorkerError():
                self._error = event.reason

    def _advance(self, event: ReconstructionStatus) -> None:
        before = self.row
        self.row = replace(
            before,
            stage=event.stage,
            progress=event.progress,
            tracking_state=event.state,
            reason=event.reason,
            frames=event.frames,
            poses=max(event.poses, before.poses) if not event.version else event.poses,
            splats=event.splats,
            loss=event.loss,
            psnr_db=event.psnr_db,
            eta_s=event.eta_s,
            warnings=event.warnings,
        )
        if event.stage is Stage.REFINING and before.stage is not Stage.REFINING and self._must_yield(self.row):
            self._yielded = True
            self._stop()
        if event.stage is not before.stage or time.monotonic() - self._saved_s > _SAVE_S:
            self._save()
        else:
            self._rows.update(self.row)

    def _publish(self, event: VersionPublished) -> None:
        self._again_of, published = event.again_of, event.published
        self.row = replace(
            self.row,
            version=published.version,
            white=published.white,
            poses=published.poses,
            splats=published.splats,
        )
        self._rows.add_version(self.row, published, set(event.kept))
        self._save()
        self._notifier.scene(self.row, published)

    def _save(self) -> None:
        self._saved_s = time.monotonic()
        self._rows.save(self.row)

    def _not_one_place(self) -> str:
        if self.row.task is Task.EXTEND:
            used = self.row.maps[0].reconstruction_id
            return f"the map {used} was not extended: {self._mismatch}; the versions show the recording alone"
        return self._mismatch

    def _remarks(self) -> str:
        """Remarks on a complete reconstruction; empty if it tracked and refined all frames."""
        remarks = [] if self.row.tracking_state is State.TRACK else [self.row.reason]
        if self._early:
            remarks.append(f"the refinement was ended at {self.row.progress:.0%}")
        if self._again_of is not None:
            remarks.append(
                f"version {self._again_of} matches the recording better than the last one and is published again"
            )
        return "; ".join(remarks)


def queued_again(row: ReconstructionRow, reason: str) -> ReconstructionRow:
    """The row of a reconstruction that is to restart from the recording."""
    return replace(
        row,
        live=False,
        state=JobState.QUEUED,
        stage=Stage.WAITING,
        progress=0.0,
        eta_s=None,
        reason=reason,
        ended_at=None,
        attempt="",
    )


def begun_anew(row: ReconstructionRow, options: ReconstructionOptions) -> ReconstructionRow:
    """The row of a reconstruction that a user restarts; version numbers continue."""
    return ReconstructionRow(
        row.id,
        row.capture_id,
        False,
        JobState.QUEUED,
        row.created_at,
        options=options,
        priority=row.priority,
        version=row.version,
        white=row.white,
        poses=row.poses,
        splats=row.splats,
        task=row.task,
        maps=row.maps,
        part=row.part,
        name=row.name,
        notes=row.notes,
        poses_from=row.poses_from,
        calibration_from=row.calibration_from,
        user=row.user,
    )
