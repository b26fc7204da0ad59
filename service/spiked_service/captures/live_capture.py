"""One live capture: its acquisition, recorder and live reconstruction."""

import threading
from collections.abc import Callable, Mapping
from dataclasses import replace
from datetime import UTC, datetime

from spiked.errors import SpikedError
from spiked.recording.geometry import orientation_questions
from spiked.ring import DeviceState
from spiked_service.captures.acquisition import AcquisitionSupervisor
from spiked_service.captures.live_row import LiveRow
from spiked_service.captures.recorder import RecorderSupervisor, RecordingResult
from spiked_service.captures.recording_quality import completed
from spiked_service.captures.ring_counts import RingCount
from spiked_service.captures.states import CaptureEvent, device_event
from spiked_service.reconstructions.notifier import Notifier
from spiked_service.reconstructions.queue import Reconstructions
from spiked_service.store.catalogue import Catalogue
from spiked_service.store.folder import DataFolder
from spiked_service.store.rows import CaptureRow, CaptureState, Counters, JobState, ReconstructionRow
from spiked_service.workers.messages import AcquisitionCommand, PreviewTaken, RecorderCommand, RingOpened, Role
from spiked_service.workers.process import StandbyWorker

BACKLOG_S = 1.7
"""The tracker pauses for about 1 s to initialise; its reader may lag 7/8 of the ring."""
_NO_FRAMES: Mapping[DeviceState | None, str] = {
    DeviceState.ABSENT: "the camera was absent",
    DeviceState.LOST: "the camera sent nothing",
    None: "it was stopped before the first frame",
}


class LiveCapture:
    """Runs a capture until its source and all readers of its ring have ended. Thread-safe.

    Listens to its acquisition, its recorder and its live reconstruction; `states` lists what their events lead to.
    """

    def __init__(
        self,
        row: CaptureRow,
        folder: DataFolder,
        catalogue: Catalogue,
        reconstructions: Reconstructions,
        notifier: Notifier,
        on_change: Callable[["LiveCapture"], None],
    ) -> None:
        self._folder = folder
        self._reconstructions = reconstructions
        self._notifier = notifier
        self._lock = threading.RLock()
        self._row = LiveRow(row, catalogue, notifier, lambda: on_change(self))
        self._acquisition: AcquisitionSupervisor | None = None
        self._recorder: RecorderSupervisor | None = None
        self._reconstruction_id: str | None = None
        planned = {Role.RECORDER: row.plan.record, Role.RECONSTRUCTION: row.plan.reconstruct}
        self._readers = {role for role, wanted in planned.items() if wanted}
        """Readers of the ring that have not ended."""
        self.opened: RingOpened | None = None
        self._first_frame = 0
        self._stop_frame: int | None = None
        self._away: DeviceState | None = None
        """Why the device sends nothing, if it does not."""
        self._source_ended = False
        self._stopping = False
        self._closing = False

    @property
    def id(self) -> str:
        """Id of the capture."""
        return self.row.id

    @property
    def row(self) -> CaptureRow:
        """The current row."""
        return self._row.now

    @property
    def holds_device(self) -> bool:
        """Whether its source is still in use."""
        return self._acquisition is not None and not self._acquisition.ended

    @property
    def picture(self) -> PreviewTaken | None:
        """The newest preview images."""
        return None if self._acquisition is None else self._acquisition.picture

    def counters(self) -> Counters | None:
        """Counters of its frames, now or at the end."""
        return None if self._acquisition is None else self._acquisition.counters()

    def ring_count(self) -> RingCount | None:
        """What its ring has counted; None before it exists."""
        row, acquisition = self.row, self._acquisition
        return None if acquisition is None else acquisition.ring_count(row.state.over, row.recording)

    def acquire(self) -> None:
        """Start an acquisition of its own. Raises OSError."""
        plan = self.row.plan
        command = AcquisitionCommand(
            capture_id=self.id,
            source=plan.source,
            ring_id=self.id,
            frames=plan.frames,
            seconds=plan.seconds,
            consumers=1 + plan.record + plan.reconstruct,
            history_s=0.0,
            backlog_s=BACKLOG_S if plan.reconstruct else 0.0,
            profiles=self._folder.profiles,
        )
        with self._lock:
            self._acquisition = AcquisitionSupervisor(
                command, self._folder.capture(self.id) / "logs", self._folder.thumbnail(self.id), self
            )

    def attach_running(
        self,
        acquisition: AcquisitionSupervisor,
        first_frame: int,
        stop_frame: int | None,
        recorder: StandbyWorker | None = None,
        reconstructor: StandbyWorker | None = None,
    ) -> None:
        """Use an acquisition that runs already; start at a frame that its ring still holds."""
        assert acquisition.opened is not None, "a running acquisition has opened its ring"
        with self._lock:
            self._acquisition, self._first_frame, self._stop_frame = acquisition, first_frame, stop_frame
            acquisition.hand_over(self, first_frame, stop_frame)
            self._source_ended = acquisition.ended
            self._row.warn(*acquisition.warnings)
            self._begin(acquisition.opened, recorder, reconstructor)

    def update_state(self) -> None:
        """Set the state from the counters; called periodically, because the ring sends no events."""
        with self._lock:
            counters = self.counters()
            if self._stopping or not self.holds_device or self.opened is None or counters is None:
                return
            event = device_event(counters, self._first_frame)
            self._away = counters.device if event is CaptureEvent.DEVICE_AWAY else None
            self._row.apply(event)

    def edit(self, **fields: object) -> None:
        """Change what a user may change of the row. Raises StoreError."""
        self._row.edit(**fields)

    def save(self) -> bool:
        """Save the row, if an earlier attempt failed. Return whether that succeeded."""
        return self._row.save()

    def stop(self) -> None:
        """End the acquisition; the reconstruction continues with its refinement. A second call ends that as well."""
        self.update_state()
        with self._lock:
            self._stopping = True
            if self.row.state is CaptureState.FINISHING and self._reconstruction_id is not None:
                self._reconstructions.finish_early(self._reconstruction_id)
            else:
                self._stop_source()

    def dismiss(self) -> None:
        """Ask all workers to exit at once."""
        with self._lock:
            self._stopping = self._closing = True
            recorder, acquisition = self._recorder, self._acquisition
        if acquisition is not None:
            acquisition.dismiss()
        if recorder is not None:
            recorder.dismiss()

    def join(self, timeout_s: float) -> None:
        """Wait for dismissed workers; kill those that have not exited after `timeout_s`."""
        if self._acquisition is not None:
            self._acquisition.join(timeout_s)
        if self._recorder is not None:
            self._recorder.join(timeout_s)
        if self._acquisition is not None:
            self._acquisition.release()

    def processes(self) -> dict[str, int]:
        """Process ids of the running workers by role, without the reconstruction's."""
        found = {} if self._acquisition is None else self._acquisition.processes()
        pid = None if self._recorder is None else self._recorder.pid
        return found if pid is None else found | {Role.RECORDER: pid}

    def ring_opened(self, opened: RingOpened) -> None:
        """See `AcquisitionListener`."""
        self._begin(opened, None, None)

    def preview_taken(self, taken: PreviewTaken) -> None:
        """See `AcquisitionListener`."""
        self._notifier.preview(self.id, taken)

    def warned(self, text: str) -> None:
        """See `AcquisitionListener` and `RecorderListener`."""
        self._notifier.log("warning", text, self.id)
        self._row.warn(text)

    def acquisition_ended(self, trouble: str | None) -> None:
        """See `AcquisitionListener`."""
        with self._lock:
            self._source_ended = True
            if trouble is not None:
                self._row.fail(trouble)
            if self.opened is None:
                self._readers.clear()
            elif not self.row.state.over:
                self._row.apply(CaptureEvent.SOURCE_ENDED)
            self._finish_if_done()

    def acquisition_finished(self) -> None:
        """See `AcquisitionListener`."""
        with self._lock:
            self._finish_if_done()

    def recording_failed(self, reason: str) -> None:
        """See `RecorderListener`."""
        with self._lock:
            self._row.fail(reason)
            self._stop_source()

    def recording_ended(self, result: RecordingResult) -> None:
        """See `RecorderListener`."""
        with self._lock:
            self._row.set(recording=result.recording, verdict=result.verdict)
            if result.trouble:
                self._row.fail(result.trouble)
            if not result.detached and self._acquisition is not None:
                self._acquisition.drop_readers(Role.RECORDER)
            self._readers.discard(Role.RECORDER)
            self._stop_source()
            self._finish_if_done()
        self._reconstructions.wake_queue()

    def _reconstruction_ended(self, row: ReconstructionRow) -> None:
        with self._lock:
            self._readers.discard(Role.RECONSTRUCTION)
            if self._acquisition is not None:
                self._acquisition.drop_readers(Role.RECONSTRUCTION)
            if not self.row.plan.record:  # nobody reads the ring any more
                if row.state is JobState.FAILED:
                    self._row.fail(row.reason)
                self._stop_source()
            elif row.state is JobState.FAILED or (row.state is JobState.QUEUED and row.reason):
                self.warned(row.reason)  # queued without a reason: it waits for a free worker
            self._finish_if_done()

    def _begin(self, opened: RingOpened, recorder: StandbyWorker | None, reconstructor: StandbyWorker | None) -> None:
        with self._lock:
            if self._closing:
                return
            self.opened = opened
            sensor = replace(opened.sensor, intrinsics=self.row.plan.intrinsics or opened.sensor.intrinsics)
            frames = opened.frames if self._stop_frame is None else self._stop_frame - self._first_frame
            self._row.set(sensor=sensor, frames_planned=frames)
            self._row.warn(*orientation_questions(opened.assumed, sensor))
            try:
                if Role.RECORDER in self._readers:
                    self._start_recorder(opened, recorder)
                if Role.RECONSTRUCTION in self._readers:
                    self._start_reconstruction(opened, reconstructor)
            except (OSError, SpikedError) as error:
                # Readers that did start continue to the end of the ring, which follows from the stop.
                started = {Role.RECORDER: self._recorder, Role.RECONSTRUCTION: self._reconstruction_id}
                self._readers &= {role for role, reader in started.items() if reader is not None}
                self._row.fail(
                    f"the workers of the capture cannot be started: {error}; check the disk of the data folder"
                )
                self._stop_source()

    def _start_recorder(self, opened: RingOpened, standby: StandbyWorker | None) -> None:
        """Raises OSError."""
        plan = self.row.plan
        command = RecorderCommand(
            capture_id=self.id,
            ring=opened.name,
            path=self._folder.recording(self.id),
            first_frame=self._first_frame,
            stop_frame=self._stop_frame,
            resume=False,
            intrinsics=plan.intrinsics,
            source=plan.source,
            note=plan.name,
            profile=opened.profile,
            calibration=opened.calibration,
            assumed=opened.assumed,
        )
        log = self._folder.capture(self.id) / "logs" / "recorder.log"
        self._recorder = RecorderSupervisor(command, log, self, standby)

    def _start_reconstruction(self, opened: RingOpened, standby: StandbyWorker | None) -> None:
        """Raises OSError or StoreError."""
        row = self._reconstructions.begin_live(
            self.row,
            opened,
            self._reconstruction_ended,
            first_frame=self._first_frame,
            stop_frame=self._stop_frame,
            standby=standby,
        )
        self._reconstruction_id = row.id

    def _stop_source(self) -> None:
        if self._acquisition is not None and not self._acquisition.ended:
            self._acquisition.stop()

    def _finish_if_done(self) -> None:
        """End the capture when acquisition, recorder and live reconstruction have ended."""
        if self.row.state.over or self._readers or not self._source_ended:
            return
        if self._acquisition is None or not self._acquisition.finished:
            return
        counters = self.counters()
        self._acquisition.release()
        if counters is not None:
            self._complete_recording(counters)
        if self._closing and not self.row.reason:
            self._row.set(reason="ended with the service")
        event = CaptureEvent.FAILED if self._row.failed else CaptureEvent.FINISHED
        self._row.apply(event, counters=counters, ended_at=datetime.now(UTC))
        self._reconstructions.wake_queue()

    def _complete_recording(self, counters: Counters) -> None:
        """Count frames that are not in the recording as lost; state the reason if the capture has none."""
        last = counters.next_frame if self._stop_frame is None else min(counters.next_frame, self._stop_frame)
        frames = last - self._first_frame
        if frames <= 0 and not self.row.reason:
            self._row.set(reason=f"no frames: {_NO_FRAMES[self._away]}")
        if self.row.plan.record and frames > 0:
            path = self._folder.recording(self.id)
            recording, verdict = completed(path, frames, self.row.recording, self.row.verdict)
            self._row.set(recording=recording, verdict=verdict)
