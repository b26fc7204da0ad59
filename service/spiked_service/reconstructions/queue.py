"""All reconstructions: live ones start at once, others from a queue; failed workers are retried."""

import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from typing import Unpack

from spiked_service.base.errors import BusyError
from spiked_service.base.ids import new_id
from spiked_service.reconstructions.admission import check
from spiked_service.reconstructions.executor import Executor, LocalExecutor
from spiked_service.reconstructions.given import Given
from spiked_service.reconstructions.interruption import after_crash, cancelled, failed, requeue_interrupted
from spiked_service.reconstructions.job_commands import command_of, live_command, live_row
from spiked_service.reconstructions.job_runner import JobRunner, begun_anew
from spiked_service.reconstructions.notifier import Notifier
from spiked_service.reconstructions.queue_policy import QueuePolicy
from spiked_service.reconstructions.ready_jobs import ReadyJobs
from spiked_service.reconstructions.repository import ReconstructionRepository
from spiked_service.settings.reconstruction_options import ReconstructionOptions
from spiked_service.store.catalogue import Catalogue, StoreError
from spiked_service.store.folder import DataFolder
from spiked_service.store.rows import (
    CaptureRow,
    FrameRange,
    JobState,
    MapRef,
    ReconstructionEdit,
    ReconstructionRow,
    Stage,
    Task,
)
from spiked_service.workers.messages import JobCommand, RingOpened
from spiked_service.workers.process import StandbyWorker

_LOOK_S = 0.5
"""Interval at which the queue is checked while a retry is delayed."""
_OTHERS_S = 0.001
"""Time for others to take the lock while many jobs are cancelled."""


class Reconstructions:
    """Starts, queues and ends reconstructions, as `QueuePolicy` decides. Thread-safe.

    Rows, versions and files are read from `rows`; the limit of `policy` may be changed at any time.
    """

    def __init__(
        self,
        folder: DataFolder,
        catalogue: Catalogue,
        notifier: Notifier,
        policy: QueuePolicy,
        rows: ReconstructionRepository,
        executor: Executor | None = None,
    ) -> None:
        """`executor` runs the jobs of the queue; live ones run on this machine, where their ring is."""
        self._executor = executor or LocalExecutor()
        self._folder = folder
        self._catalogue = catalogue
        self._notifier = notifier
        self.policy = policy
        self.rows = rows
        self._lock = threading.RLock()
        self._wake = threading.Condition(self._lock)
        self._jobs: dict[str, JobRunner] = {}
        self._least_poses: dict[str, int] = {}
        """Poses of the published trajectory of a queued reconstruction, which a restart has to reach."""
        self._ready = ReadyJobs(catalogue, rows, policy, self.cancel)
        self._closing = False
        self._thread: threading.Thread | None = None
        requeue_interrupted(rows, adopted=executor is not None)

    def start(self) -> None:
        """Start the queue. Call once, after interrupted recordings have been recovered."""
        with self._lock:
            if self._closing:  # the service has stopped meanwhile
                return
            for row in [one for one in self.rows.interrupted() if one.id not in self._jobs]:
                self._adopt(row)
            self._ready.find_removed()
            self._executor.clean_up()
            self._thread = threading.Thread(target=self._run_queue, name="queue", daemon=True)
            self._thread.start()

    def begin_live(
        self,
        capture: CaptureRow,
        opened: RingOpened,
        on_end: Callable[[ReconstructionRow], None],
        *,
        first_frame: int = 0,
        stop_frame: int | None = None,
        standby: StandbyWorker | None = None,
    ) -> ReconstructionRow:
        """Reconstruct a capture while it runs. `on_end` is called once, when its worker no longer reads the ring."""
        row = live_row(capture)
        command = live_command(row, capture, opened, self._folder, first_frame, stop_frame)
        with self._lock:
            self._begin(row, command, standby, on_end)
        return row

    def submit(
        self,
        capture_id: str,
        options: ReconstructionOptions | None = None,
        priority: int = 0,
        *,
        task: Task = Task.RECONSTRUCT,
        map_ids: Sequence[str] = (),
        part: FrameRange | None = None,
        given: Given | None = None,
        user: str = "",
    ) -> ReconstructionRow:
        """Queue a job of a capture; one that needs the recording waits while the capture runs.

        `map_ids` are the reconstructions whose newest versions the `task` uses, two of a merge; they lie in the folder
        of the job from now on, as does what is `given`. `part` are the frames to localise. `user` is who asks.
        Raises UnknownIdError, BusyError for a map that is not finished, StoreError, and ConfigurationError for a
        capture without a recording, what is no map, another camera whose lens is not known, poses that are no path.
        """
        row = _queued(capture_id, options, priority, task, map_ids, part, user)
        try:
            # Before the lock: a path of a minute is a large file, and captures that begin and end wait for the lock.
            row = (given or Given()).put(row, self._folder, self.rows, self._catalogue.captures.get(capture_id))
            with self._lock:
                check(row, self._catalogue, self.rows)
                added = self.rows.add(self.rows.pin_maps(row))
                self._wake.notify_all()
        except BaseException:
            self._folder.remove(self._folder.reconstruction(row.id))
            raise
        return added

    def change(self, reconstruction_id: str, **edit: Unpack[ReconstructionEdit]) -> ReconstructionRow:
        """Change the fields that are given. One that runs is held by ending its worker, which takes a second.

        Raises UnknownIdError, StoreError, and BusyError for one that can be neither held nor moved.
        """
        with self._lock:
            job = self._jobs.get(reconstruction_id)
            if job is not None and edit.get("held"):
                if job.row.live:
                    raise BusyError(f"reconstruction {job.row.id} follows its capture: stop that, or wait for its end")
                edit["held"] = None
                row = self.rows.change(reconstruction_id, **edit)
                job.hold()
            else:
                row = self.rows.change(reconstruction_id, **edit)
            self._wake.notify_all()
            return row

    def cancel(self, reconstruction_id: str) -> ReconstructionRow:
        """End a queued or running reconstruction; published versions are kept. Does nothing to one that has ended."""
        with self._lock:
            if (job := self._jobs.get(reconstruction_id)) is not None:
                job.cancel()
                return job.row
            row = self.rows.get(reconstruction_id)
            if row.state is JobState.QUEUED:
                self.policy.reset_retries(row.id)
                self.rows.drop_checkpoint(row.id)
                row = self.rows.save(cancelled(row))
            return row

    def cancel_all_of(self, capture_id: str) -> None:
        """End the jobs of a removed capture: those that run and some that wait now, the others soon."""
        with self._lock:
            for job in [one for one in self._jobs.values() if one.row.capture_id == capture_id]:
                job.cancel()
            self._ready.remove(capture_id)
            self._wake.notify_all()

    def finish_early(self, reconstruction_id: str) -> None:
        """End the refinement of a running reconstruction; it counts as complete."""
        with self._lock:
            if (job := self._jobs.get(reconstruction_id)) is not None:
                job.finish_early()

    def restart(self, reconstruction_id: str, options: ReconstructionOptions | None = None) -> ReconstructionRow:
        """Queue an ended reconstruction again; version numbers continue.

        Raises BusyError if it has not ended, StoreError, and then it stays ended.
        """
        with self._lock:
            row = self.rows.get(reconstruction_id)
            if not row.state.over:
                raise BusyError(f"reconstruction {row.id} is {row.state}: cancel it, or wait for its end")
            self.rows.check_not_edited(row.id)
            check(row, self._catalogue, self.rows)
            begun = self.rows.pin_maps(begun_anew(row, options or row.options))
            self.policy.reset_retries(row.id)
            self.rows.drop_checkpoint(row.id)
            try:
                self.rows.requeue(begun)
            except StoreError:
                self.rows.unpin_maps(row)
                raise
            self._wake.notify_all()
            return begun

    def remove(self, reconstruction_id: str) -> None:
        """Delete a reconstruction with its versions. Raises BusyError while its worker runs."""
        with self._lock:
            row = self.rows.get(reconstruction_id)
            if row.state is JobState.RUNNING:
                raise BusyError(f"reconstruction {row.id} is running: cancel it first")
            self.rows.remove(row.id)

    def while_idle(self, capture_id: str, work: Callable[[], None]) -> None:
        """Do work while no job of a capture begins. Raises BusyError if one of them runs, or is edited."""
        with self._lock:
            if self._catalogue.job_counts(capture_id)[JobState.RUNNING]:
                raise BusyError(f"a reconstruction of capture {capture_id} is running: cancel it first")
            self.rows.check_none_edited(capture_id)
            work()

    def wake_queue(self) -> None:
        """Check the queue: the recording of a capture has been closed, or will not exist, or rows have been saved."""
        with self._lock:
            self._wake.notify_all()

    def processes(self) -> dict[str, int]:
        """Process ids of the running workers, by reconstruction."""
        with self._lock:
            return {key: job.pid for key, job in self._jobs.items() if job.pid is not None}

    def dismiss(self) -> None:
        """Ask every worker to exit at once, and start no other."""
        with self._lock:
            self._closing = True
            jobs = list(self._jobs.values())
            self._wake.notify_all()
        for job in jobs:
            job.detach()

    def join(self, timeout_s: float) -> None:
        """Wait for dismissed workers; kill those that have not exited after `timeout_s`."""
        with self._lock:
            jobs, thread = list(self._jobs.values()), self._thread
        for job in jobs:
            job.kill_after(timeout_s)
        if thread is not None:
            thread.join()
        self.rows.close()

    def _run_queue(self) -> None:
        while True:
            with self._lock:
                if self._closing:
                    return
                wait_s = _LOOK_S if self.policy.delays else None
                try:
                    self._begin_next()
                    wait_s = _OTHERS_S if self._ready.cancel_some() else wait_s
                except (StoreError, OSError) as error:
                    self._notifier.log("error", f"no reconstruction can be started: {error}")
                self._wake.wait(wait_s)

    def _begin_next(self) -> None:
        ready = iter(self._ready)
        while len(self._jobs) < self.policy.limit and (found := next(ready, None)) is not None:
            self._begin_queued(*found)

    def _begin_queued(self, row: ReconstructionRow, capture: CaptureRow) -> None:
        if not self.rows.has_checkpoint(row.id):
            self.rows.forget_scale(row)
        command = command_of(row, capture, self._folder, self._least_poses.pop(row.id, 0))
        begun = replace(row, state=JobState.RUNNING, stage=Stage.WAITING, ended_at=None, attempts=row.attempts + 1)
        self._begin(replace(begun, started_at=datetime.now(UTC)), command)

    def _begin(
        self,
        row: ReconstructionRow,
        command: JobCommand,
        standby: StandbyWorker | None = None,
        on_end: Callable[[ReconstructionRow], None] | None = None,
    ) -> None:
        job = self._runner(row, LocalExecutor() if row.live else self._executor, on_end)
        try:
            job.start(command, standby)
        except OSError as error:
            del self._jobs[row.id]
            self.rows.save(failed(row, f"its worker cannot be started: {error.strerror}"))
            raise

    def _adopt(self, row: ReconstructionRow) -> None:
        """Follow a job that runs elsewhere since before the service was started."""
        capture = self._catalogue.captures.find(row.capture_id)
        if capture is None:
            self.rows.save(failed(row, "its capture has been removed"))
        else:
            self._runner(row, self._executor).adopt(command_of(row, capture, self._folder, 0))

    def _runner(
        self, row: ReconstructionRow, executor: Executor, on_end: Callable[[ReconstructionRow], None] | None = None
    ) -> JobRunner:
        job = JobRunner(
            row,
            executor,
            self.rows,
            self._notifier,
            self._must_yield,
            lambda job, trouble: self._ended(job, trouble, on_end),
        )
        self._jobs[row.id] = job
        return job

    def _must_yield(self, row: ReconstructionRow) -> bool:
        """Whether a job that begins to refine must return to the queue, from which it restarts with its recording."""
        with self._lock:
            capture = self._catalogue.captures.find(row.capture_id)
            if capture is None or not capture.plan.record:
                return False
            others = [job.row for job in self._jobs.values() if job.row.id != row.id]
            return self.policy.must_yield(row, others, any(True for _ in self.rows.queued()))

    def _ended(self, job: JobRunner, trouble: str | None, on_end: Callable[[ReconstructionRow], None] | None) -> None:
        with self._lock:
            row = job.row
            del self._jobs[row.id]
            # A job that is interrupted by the end of the service stays "running": the next start queues it again.
            if not self._closing or (trouble is None and row.stage is Stage.DONE):
                row = self.rows.save(self._outcome(job, trouble))
            elif not row.live and not row.attempt:
                row = self.rows.save(replace(row, attempts=row.attempts - 1))  # it has nothing to do with this end
            self._wake.notify_all()
        if on_end is not None:
            on_end(row)

    def _outcome(self, job: JobRunner, trouble: str | None) -> ReconstructionRow:
        row = job.outcome(trouble)
        if row is None:
            return after_crash(job.row, f"{trouble}", self.rows, self._catalogue, self.policy, begun=not job.not_begun)
        if row.state is JobState.QUEUED:
            self._least_poses[row.id] = row.poses
        return row


def _queued(
    capture_id: str,
    options: ReconstructionOptions | None,
    priority: int,
    task: Task,
    map_ids: Sequence[str],
    part: FrameRange | None,
    user: str,
) -> ReconstructionRow:
    return ReconstructionRow(
        new_id(),
        capture_id,
        False,
        JobState.QUEUED,
        datetime.now(UTC),
        options=options or ReconstructionOptions(),
        priority=priority,
        task=task,
        maps=tuple(MapRef(map_id) for map_id in map_ids),
        part=part,
        user=user,
    )
