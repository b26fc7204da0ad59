"""All reconstructions: live ones at once, those from recordings from a queue, and what follows a death."""

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path

from spiked.errors import ConfigurationError
from spiked.recon import State
from spiked.sensor import Intrinsics
from spiked_service.announcer import Announcer
from spiked_service.backoff import Backoff
from spiked_service.child import Child, Spare
from spiked_service.chronicle import NAME as TIMELINE
from spiked_service.errors import BusyError
from spiked_service.ids import new_id
from spiked_service.messages import (
    News,
    Outpaced,
    Posed,
    ReconstructionOrder,
    ReconstructionStatus,
    Refused,
    RingOpened,
    Stage,
    VersionPublished,
)
from spiked_service.reconstruction_options import ReconstructionOptions
from spiked_service.store.catalogue import Catalogue, Page, StoreError
from spiked_service.store.folder import DataFolder
from spiked_service.store.rows import CaptureRow, JobState, ReconstructionRow, VersionRow

_SAVE_S = 5.0
"""How a running reconstruction stands is written down this often, and at once when its stage or version changes."""
_DELAYS_S = (1.0, 5.0)
"""A worker that died is followed by another after these times; then the reconstruction has failed."""
_LOOK_S = 0.5
_MOST_ATTEMPTS = 6


@dataclass
class _Job:
    """A reconstruction whose worker runs."""

    row: ReconstructionRow
    child: Child | None = None
    cancelled: bool = False
    refusal: str | None = None
    early: bool = False
    """Asked to be done with what it has."""
    outpaced: Outpaced | None = None
    saved_s: float = field(default_factory=time.monotonic)


class Reconstructions:
    """Every method may be called from any thread.

    Of the recordings that wait, the one with the highest priority is next, the oldest of equals; at most `limit`
    reconstructions run at once, and as long as live ones fill that limit, none is begun from the queue.
    """

    def __init__(
        self,
        folder: DataFolder,
        catalogue: Catalogue,
        announce: Announcer,
        limit: int = 1,
        delays_s: tuple[float, ...] = _DELAYS_S,
    ) -> None:
        self._folder = folder
        self._catalogue = catalogue
        self._announce = announce
        self.limit = limit
        """May be changed at any time."""
        self._delays_s = delays_s
        self._lock = threading.RLock()
        self._wake = threading.Condition(self._lock)
        self._jobs: dict[str, _Job] = {}
        self._unsaved: dict[str, ReconstructionRow] = {}
        self._backoffs: dict[str, Backoff] = {}
        self._least_poses: dict[str, int] = {}
        self._not_before_s: dict[str, float] = {}
        self._on_live_end: dict[str, Callable[[ReconstructionRow], None]] = {}
        self._closing = False
        self._thread: threading.Thread | None = None
        self._take_up()

    def start(self) -> None:
        """Begin to work off the queue: to be called once, when interrupted recordings are whole again."""
        with self._lock:
            if self._closing:  # the service has ended meanwhile
                return
            thread = threading.Thread(target=self._run_queue, name="queue", daemon=True)
            thread.start()
            self._thread = thread

    def _take_up(self) -> None:
        """What an earlier service left running begins again from its recording; what waited waits on."""
        for row in self._catalogue.reconstructions.where("state = ?", (str(JobState.RUNNING),)):
            if row.attempts >= _MOST_ATTEMPTS:
                told = f"given up after {row.attempts} attempts, the last of which the end of the service cut off"
                self._save(replace(row, state=JobState.FAILED, reason=told, ended_at=datetime.now(UTC)))
                continue
            told = "begun again from the recording, because the service ended while it ran"
            self._save(replace(row, live=False, state=JobState.QUEUED, stage=Stage.WAITING, progress=0.0, reason=told))

    def begin_live(
        self,
        capture: CaptureRow,
        opened: RingOpened,
        on_end: Callable[[ReconstructionRow], None],
        *,
        first_frame: int = 0,
        stop_frame: int | None = None,
        spare: Spare | None = None,
    ) -> ReconstructionRow:
        """Reconstruct a capture while it runs. `on_end` is called once, when no worker reads the ring any more."""
        options = capture.plan.options
        now = datetime.now(UTC)
        row = ReconstructionRow(new_id(), capture.id, True, JobState.RUNNING, now, options=options, started_at=now)
        order = ReconstructionOrder(
            capture_id=capture.id,
            reconstruction_id=row.id,
            ring=opened.name,
            recording=None,
            folder=self._folder.reconstruction(row.id),
            unhurried=opened.unhurried,
            options=options,
            intrinsics=_intrinsics(options, capture),
            first_frame=first_frame,
            stop_frame=stop_frame,
            recorded=capture.plan.record,
        )
        with self._lock:
            self._on_live_end[row.id] = on_end
            return self._begin(replace(row, attempts=1), order, spare)

    def submit(
        self, capture_id: str, options: ReconstructionOptions | None = None, priority: int = 0
    ) -> ReconstructionRow:
        """Reconstruct a capture from its recording, which may still be running: then it waits for the end.

        Raises UnknownIdError, and ConfigurationError for a capture that has no recording or no known optics.
        """
        capture = self._catalogue.captures.get(capture_id)
        chosen = options or ReconstructionOptions()
        _check(capture)
        row = ReconstructionRow(
            new_id(), capture_id, False, JobState.QUEUED, datetime.now(UTC), options=chosen, priority=priority
        )
        with self._lock:
            self._catalogue.reconstructions.put(row)
            self._announce.job(row)
            self._wake.notify_all()
        return row

    def get(self, reconstruction_id: str) -> ReconstructionRow:
        """As it stands now. Raises UnknownIdError."""
        return self._current(self._catalogue.reconstructions.get(reconstruction_id))

    def list(
        self,
        limit: int = 50,
        cursor: str | None = None,
        capture_id: str | None = None,
        state: JobState | None = None,
    ) -> Page[ReconstructionRow]:
        """As they stand now, newest first."""
        page = self._catalogue.reconstruction_page(limit, cursor, capture_id, state)
        return Page([self._current(row) for row in page.items], page.next_cursor)

    def of(self, capture_id: str) -> tuple[ReconstructionRow, ...]:
        """Those of a capture, oldest first."""
        return tuple(self._current(row) for row in self._catalogue.reconstructions_of(capture_id))

    def counts(self) -> dict[JobState, int]:
        """How many there are in each state."""
        found = self._catalogue.read("SELECT state, count(*) FROM reconstructions GROUP BY state")
        return dict.fromkeys(JobState, 0) | {JobState(state): count for state, count in found}

    def folder(self, reconstruction_id: str) -> Path:
        """Where its versions lie. Raises UnknownIdError."""
        return self._folder.reconstruction(self._catalogue.reconstructions.get(reconstruction_id).id)

    def log(self, reconstruction_id: str) -> Path:
        """What its workers wrote; may not be there. Raises UnknownIdError."""
        return self.folder(reconstruction_id) / "log"

    def timeline(self, reconstruction_id: str) -> Path:
        """See `timeline.Timeline`; may not be there. Raises UnknownIdError."""
        return self.folder(reconstruction_id) / TIMELINE

    def versions(self, reconstruction_id: str) -> Sequence[VersionRow]:
        """Versions that can be read, oldest first. Raises UnknownIdError."""
        return self._catalogue.versions(self._catalogue.reconstructions.get(reconstruction_id).id)

    def cancel(self, reconstruction_id: str) -> ReconstructionRow:
        """End one that waits or runs; what it has published stays. Nothing happens to one that is over."""
        with self._lock:
            job = self._jobs.get(reconstruction_id)
            if job is not None:
                job.cancelled = True
                if job.child is not None:
                    job.child.stop()
                return job.row
            row = self.get(reconstruction_id)
            if row.state is JobState.QUEUED:
                row = self._save(replace(row, state=JobState.CANCELLED, reason="", ended_at=datetime.now(UTC)))
            return row

    def finish_early(self, reconstruction_id: str) -> None:
        """Cut the refinement of a running one; it counts as complete."""
        with self._lock:
            job = self._jobs.get(reconstruction_id)
            if job is not None and job.child is not None:
                job.early = True
                job.child.stop()

    def restart(self, reconstruction_id: str, options: ReconstructionOptions | None = None) -> ReconstructionRow:
        """Begin one that is over again from the recording; its versions count on. Raises BusyError while it is not."""
        with self._lock:
            row = self.get(reconstruction_id)
            if not row.state.over:
                raise BusyError(f"reconstruction {row.id} is {row.state}: cancel it, or wait for its end")
            chosen = options or row.options
            _check(self._catalogue.captures.get(row.capture_id))
            self._backoffs.pop(row.id, None)
            begun = ReconstructionRow(
                row.id,
                row.capture_id,
                False,
                JobState.QUEUED,
                row.created_at,
                options=chosen,
                priority=row.priority,
                version=row.version,
                white=row.white,
                poses=row.poses,
                splats=row.splats,
            )
            self._save(begun)
            self._wake.notify_all()
            return begun

    def remove(self, reconstruction_id: str) -> None:
        """Forget one with all it has published. Raises BusyError while its worker runs."""
        with self._lock:
            row = self.get(reconstruction_id)
            if row.state is JobState.RUNNING:
                raise BusyError(f"reconstruction {row.id} is running: cancel it first")
            self._folder.remove(self._folder.reconstruction(row.id))
            with self._catalogue.transaction():
                self._catalogue.forget_versions(row.id)
                self._catalogue.reconstructions.remove(row.id)
            self._unsaved.pop(row.id, None)

    def look_again(self) -> None:
        """A capture's recording can be read now, or there will be none: a job may wait for that."""
        with self._lock:
            self._wake.notify_all()

    def processes(self) -> dict[str, int]:
        """Process ids of the living workers, by reconstruction."""
        with self._lock:
            return {key: job.child.pid for key, job in self._jobs.items() if job.child is not None}

    def dismiss(self) -> None:
        """Tell every worker to leave at once, and begin no other."""
        with self._lock:
            self._closing = True
            children = [job.child for job in self._jobs.values()]
            self._wake.notify_all()
        for child in children:
            if child is not None:
                child.dismiss()

    def join(self, timeout_s: float) -> None:
        """Wait for dismissed workers, and kill those that stay."""
        with self._lock:
            children = [job.child for job in self._jobs.values()]
        for child in children:
            if child is not None:
                child.kill_after(timeout_s)
        with self._lock:
            thread = self._thread
        if thread is not None:
            thread.join()

    def retry_saving(self) -> None:
        """Write down what a full disk did not take."""
        with self._lock:
            for row in list(self._unsaved.values()):
                self._save(row)

    def _run_queue(self) -> None:
        while True:
            with self._lock:
                if self._closing:
                    return
                try:
                    self._begin_next()
                except (StoreError, OSError) as error:
                    self._announce.log("error", f"the queue of reconstructions waits: {error}")
                self._wake.wait(_LOOK_S if self._not_before_s else None)

    def _begin_next(self) -> None:
        queued = self._catalogue.reconstructions.where("state = ? ORDER BY priority DESC, id", (str(JobState.QUEUED),))
        for row in queued:
            if len(self._jobs) >= self.limit:
                return
            if time.monotonic() < self._not_before_s.get(row.id, 0.0) or row.id in self._unsaved:
                continue
            self._not_before_s.pop(row.id, None)
            capture = self._catalogue.captures.find(row.capture_id)
            if capture is None or (capture.state.over and capture.recording is None):
                why = row.reason or "the capture has no recording"
                self._save(replace(row, state=JobState.FAILED, reason=why, ended_at=datetime.now(UTC)))
            elif capture.recording is not None and capture.recording.frames:
                self._begin_from_recording(row, capture)

    def _begin_from_recording(self, row: ReconstructionRow, capture: CaptureRow) -> None:
        order = ReconstructionOrder(
            capture_id=capture.id,
            reconstruction_id=row.id,
            ring=None,
            recording=self._folder.recording(capture.id),
            folder=self._folder.reconstruction(row.id),
            unhurried=True,
            options=row.options,
            intrinsics=_intrinsics(row.options, capture),
            least_poses=self._least_poses.pop(row.id, 0),
        )
        now = datetime.now(UTC)
        begun = replace(
            row, state=JobState.RUNNING, stage=Stage.WAITING, started_at=now, ended_at=None, attempts=row.attempts + 1
        )
        self._begin(begun, order, None)

    def _begin(self, row: ReconstructionRow, order: ReconstructionOrder, spare: Spare | None) -> ReconstructionRow:
        job = self._jobs[row.id] = _Job(row)
        self._save(row)
        try:
            order.folder.mkdir(exist_ok=True)
            job.child = Child(
                order,
                order.folder / "log",
                lambda news: self._hear(job, news),
                lambda trouble: self._ended(job, trouble),
                spare,
            )
        except OSError as error:
            del self._jobs[row.id]
            self._on_live_end.pop(row.id, None)
            reason = f"its worker cannot be started: {error.strerror}"
            self._save(replace(row, state=JobState.FAILED, reason=reason, ended_at=datetime.now(UTC)))
            raise
        return row

    def _hear(self, job: _Job, news: News) -> None:
        with self._lock:
            match news:
                case ReconstructionStatus():
                    self._advance(job, news)
                case Posed():
                    self._announce.pose(job.row, news.pose)
                case VersionPublished():
                    self._published(job, news)
                case Outpaced():
                    job.outpaced = news
                case Refused():
                    job.refusal = news.reason

    def _advance(self, job: _Job, news: ReconstructionStatus) -> None:
        before = job.row
        job.row = replace(
            before,
            stage=news.stage,
            progress=news.progress,
            tracking_state=news.state,
            reason=news.reason,
            frames=news.frames,
            poses=max(news.poses, before.poses) if not news.version else news.poses,
            splats=news.splats,
            loss=news.loss,
            psnr_db=news.psnr_db,
            eta_s=news.eta_s,
        )
        if news.stage is not before.stage or time.monotonic() - job.saved_s > _SAVE_S:
            job.saved_s = time.monotonic()
            self._save(job.row)
        else:
            self._announce.job(job.row)

    def _published(self, job: _Job, news: VersionPublished) -> None:
        job.row = replace(job.row, version=news.version, white=news.white, poses=news.poses, splats=news.splats)
        version = VersionRow(
            job.row.id,
            news.version,
            datetime.now(UTC),
            news.splats,
            news.poses,
            news.white,
            news.scene_bytes,
            news.psnr_db,
        )
        try:
            self._catalogue.put_version(version, set(news.kept))
        except StoreError as error:
            self._announce.log("error", str(error), job.row.capture_id, job.row.id)
        job.saved_s = time.monotonic()
        self._save(job.row)
        self._announce.scene(job.row, news)

    def _ended(self, job: _Job, trouble: str | None) -> None:
        with self._lock:
            del self._jobs[job.row.id]
            row = job.row
            # At the service's end it stays running in the catalogue: the next service begins it again.
            if not self._closing or trouble is None:
                row = self._save(self._outcome(job, trouble))
            listener = self._on_live_end.pop(row.id, None)
            self._wake.notify_all()
        if listener is not None:
            listener(row)

    def _outcome(self, job: _Job, trouble: str | None) -> ReconstructionRow:
        row = replace(job.row, ended_at=datetime.now(UTC), eta_s=None)
        if trouble is None and job.outpaced is not None and not (job.cancelled or job.early):
            seen, passed = job.outpaced.frames, job.outpaced.passed
            told = f"followed live at a glance, {passed} of {seen} frames passed over; all are taken from the recording"
            self._least_poses[row.id] = row.poses
            return replace(
                row, live=False, state=JobState.QUEUED, stage=Stage.WAITING, progress=0.0, reason=told, ended_at=None
            )
        if job.cancelled:
            return replace(row, state=JobState.CANCELLED, stage=Stage.DONE if trouble is None else row.stage, reason="")
        if trouble is None:
            # A tracker that never began, or ended in doubt, says why; of one that tracked to its end nothing is to say.
            well = bool(row.poses) and row.tracking_state is State.TRACK
            progress = 1.0 if row.poses and not job.early else row.progress
            return replace(
                row, state=JobState.COMPLETE, stage=Stage.DONE, progress=progress, reason="" if well else row.reason
            )
        if job.refusal is not None:
            return replace(row, state=JobState.FAILED, reason=job.refusal)
        capture = self._catalogue.captures.find(row.capture_id)
        recorded = capture is not None and capture.plan.record
        delay_s = self._backoffs.setdefault(row.id, Backoff(self._delays_s)).delay_s() if recorded else None
        if delay_s is None:
            tried = f", the last of {row.attempts} attempts" if row.attempts > 1 else ""
            return replace(row, state=JobState.FAILED, reason=f"{trouble}{tried}")
        self._not_before_s[row.id] = time.monotonic() + delay_s
        told = f"{trouble}; it is begun again from the recording (attempt {row.attempts + 1})"
        return replace(
            row, live=False, state=JobState.QUEUED, stage=Stage.WAITING, progress=0.0, reason=told, ended_at=None
        )

    def _current(self, row: ReconstructionRow) -> ReconstructionRow:
        with self._lock:
            job = self._jobs.get(row.id)
            return job.row if job is not None else self._unsaved.get(row.id, row)

    def _save(self, row: ReconstructionRow) -> ReconstructionRow:
        """Write down and announce; what the disk does not take is kept in memory and tried again."""
        try:
            self._catalogue.reconstructions.put(row)
            self._unsaved.pop(row.id, None)
        except StoreError as error:
            if row.id not in self._unsaved:
                self._announce.log("error", str(error), row.capture_id, row.id)
            self._unsaved[row.id] = row
        self._announce.job(row)
        return row


def _check(capture: CaptureRow) -> None:
    if capture.deleted_at is not None:
        raise ConfigurationError(f"capture {capture.id} is deleted: restore it first")
    if not capture.plan.record or (capture.state.over and (capture.recording is None or not capture.recording.frames)):
        raise ConfigurationError(f"capture {capture.id} has no recording to reconstruct from")


def _intrinsics(options: ReconstructionOptions, capture: CaptureRow) -> Intrinsics | None:
    if options.intrinsics is not None:
        return options.intrinsics.intrinsics()
    return capture.plan.intrinsics or (None if capture.sensor is None else capture.sensor.intrinsics)
