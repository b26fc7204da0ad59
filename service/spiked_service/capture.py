"""One live capture: a stream, its recorder, its live reconstruction, and what became of them."""

import threading
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime

from spiked.errors import SpikedError
from spiked_service.announcer import Announcer
from spiked_service.backoff import Backoff
from spiked_service.child import Child, Spare
from spiked_service.judging import judged, salvaged
from spiked_service.messages import (
    News,
    PreviewTaken,
    RecorderOrder,
    RecordingEnded,
    Refused,
    RingOpened,
    Role,
)
from spiked_service.reconstructions import Reconstructions
from spiked_service.store.catalogue import Catalogue, StoreError
from spiked_service.store.folder import DataFolder
from spiked_service.store.rows import (
    CaptureRow,
    CaptureState,
    Counters,
    Grade,
    JobState,
    ReconstructionRow,
    Recorded,
)
from spiked_service.stream import Stream


class LiveCapture:
    """Follows a stream until all that reads it has ended. Every method may be called from any thread."""

    def __init__(
        self,
        row: CaptureRow,
        folder: DataFolder,
        catalogue: Catalogue,
        reconstructions: Reconstructions,
        announce: Announcer,
        on_change: Callable[["LiveCapture"], None],
    ) -> None:
        self._folder = folder
        self._catalogue = catalogue
        self._reconstructions = reconstructions
        self._announce = announce
        self._on_change = on_change
        self._lock = threading.RLock()
        self._row = row
        self._stream: Stream | None = None
        self._opened: RingOpened | None = None
        self._first_frame = 0
        self._stop_frame: int | None = None
        self._recorder: Child | None = None
        self._spare: Spare | None = None
        self._recorder_backoff = Backoff()
        self._recording = row.plan.record
        self._reconstructing = row.plan.reconstruct
        self._reconstruction_id: str | None = None
        self._account: RecordingEnded | None = None
        self._refusal: str | None = None
        self._failed = False
        self._closing = False
        self._over = threading.Event()

    @property
    def id(self) -> str:
        """Of the capture."""
        return self._row.id

    @property
    def row(self) -> CaptureRow:
        """As it stands now."""
        return self._row

    @property
    def holds_device(self) -> bool:
        """Whether its source is not free yet."""
        return self._stream is not None and not self._stream.ended

    @property
    def picture(self) -> PreviewTaken | None:
        """The newest pictures."""
        return None if self._stream is None else self._stream.picture

    def counters(self) -> Counters | None:
        """Of the ring, now or at the end."""
        return None if self._stream is None else self._stream.counters()

    def flow(self, stream: Stream) -> None:
        """Follow a stream that is about to open its ring."""
        self._stream = stream

    def join_stream(
        self,
        stream: Stream,
        first_frame: int,
        stop_frame: int | None,
        recorder: Spare | None = None,
        reconstructor: Spare | None = None,
    ) -> None:
        """Begin within a stream that flows already, at a frame that its ring still holds."""
        assert stream.opened is not None, "a stream that flows has opened its ring"
        with self._lock:
            self._stream = stream
            self._first_frame, self._stop_frame = first_frame, stop_frame
            stream.follow(self)
            if stream.warnings:
                self._row = replace(self._row, warnings=(*self._row.warnings, *stream.warnings))
            self._begin(stream.opened, recorder, reconstructor)

    def change(self, **fields: object) -> CaptureRow:
        """Replace what a user may change of the row. Raises StoreError."""
        with self._lock:
            self._row = replace(self._row, **fields)  # type: ignore[arg-type]
            self._catalogue.captures.put(self._row)
        self._on_change(self)
        return self._row

    def stop(self) -> None:
        """End the acquisition; the reconstruction goes on to refine. Asked again, it stops refining too."""
        with self._lock:
            if self._row.state is CaptureState.FINISHING and self._reconstruction_id is not None:
                self._reconstructions.finish_early(self._reconstruction_id)
            elif self._stream is not None:
                self._stream.stop()

    def dismiss(self) -> None:
        """Tell all workers to leave at once."""
        with self._lock:
            self._closing = True
            self._recorder_backoff.cancel()
            recorder, spare, stream = self._recorder, self._spare, self._stream
            self._spare = None
        if stream is not None:
            stream.dismiss()
        if recorder is not None:
            recorder.dismiss()
        if spare is not None:
            spare.dismiss()

    def join(self, timeout_s: float) -> None:
        """Wait for dismissed workers, and kill those that stay."""
        with self._lock:
            recorder, stream = self._recorder, self._stream
        if stream is not None:
            stream.join(timeout_s)
        if recorder is not None:
            recorder.kill_after(timeout_s)

    def wait(self, timeout_s: float) -> bool:
        """Wait until it is over."""
        return self._over.wait(timeout_s)

    def processes(self) -> dict[str, int]:
        """Process ids of the living workers, by role, without the reconstruction's."""
        with self._lock:
            found = {} if self._stream is None else self._stream.processes()
            return found | ({} if self._recorder is None else {Role.RECORDER: self._recorder.pid})

    def stream_opened(self, opened: RingOpened) -> None:
        """See `StreamListener`."""
        self._begin(opened, None, None)

    def picture_taken(self, taken: PreviewTaken) -> None:
        """See `StreamListener`."""
        self._announce.preview(self.id, taken)

    def warned(self, text: str) -> None:
        """See `StreamListener`."""
        self._announce.log("warning", text, self.id)
        self._set(warnings=(*self._row.warnings, text))

    def stream_ended(self, trouble: str | None) -> None:
        """See `StreamListener`."""
        with self._lock:
            if trouble is not None:
                self._fail(trouble)
            if self._opened is None:
                self._recording = self._reconstructing = False
            elif self._row.state is CaptureState.STREAMING:
                self._set(state=CaptureState.FINISHING)
            self._settle()

    def stream_settled(self) -> None:
        """See `StreamListener`."""
        with self._lock:
            self._settle()

    def _begin(self, opened: RingOpened, recorder: Spare | None, reconstructor: Spare | None) -> None:
        with self._lock:
            if self._closing:
                return
            self._opened = opened
            plan = self._row.plan
            sensor = replace(opened.sensor, intrinsics=plan.intrinsics or opened.sensor.intrinsics)
            frames = opened.frames if self._stop_frame is None else self._stop_frame - self._first_frame
            self._set(state=CaptureState.STREAMING, sensor=sensor, frames_planned=frames)
            try:
                self._start_readers(opened, recorder, reconstructor)
            except (OSError, SpikedError) as error:
                # What did not start reads nothing; what did goes on to the end that now comes.
                self._recording = self._recording and self._recorder is not None
                self._reconstructing = self._reconstruction_id is not None
                self._fail(f"the capture's workers cannot be started: {error}; look at the disk of the data folder")
                if self._stream is not None:
                    self._stream.stop()

    def _start_readers(self, opened: RingOpened, recorder: Spare | None, reconstructor: Spare | None) -> None:
        """Raises OSError or StoreError."""
        if self._recording:
            self._start_recorder(recorder)
        if self._reconstructing:
            row = self._reconstructions.begin_live(
                self._row,
                opened,
                self._reconstruction_ended,
                first_frame=self._first_frame,
                stop_frame=self._stop_frame,
                spare=reconstructor,
            )
            self._reconstruction_id = row.id

    def _start_recorder(self, spare: Spare | None = None, resume: bool = False) -> None:
        assert self._opened is not None
        plan = self._row.plan
        order = RecorderOrder(
            capture_id=self.id,
            ring=self._opened.name,
            path=self._folder.recording(self.id),
            first_frame=self._first_frame,
            stop_frame=self._stop_frame,
            resume=resume,
            intrinsics=plan.intrinsics,
            source=plan.source,
            note=plan.name,
        )
        log = self._folder.capture(self.id) / "logs" / "recorder.log"
        self._recorder = Child(order, log, self._hear_recorder, self._recorder_ended, spare)
        # Another stands by, so that a recorder that is killed is followed while the ring still holds what it missed.
        self._spare = Spare(Role.RECORDER, log)

    def _hear_recorder(self, news: News) -> None:
        match news:
            case RecordingEnded():
                self._account = news
            case Refused():
                self._refusal = news.reason

    def _recorder_ended(self, trouble: str | None) -> None:
        with self._lock:
            self._recorder = None
            if self._account is not None:
                self._recorded(self._account)
            elif self._closing:
                return  # the next service makes the recording whole
            elif self._refusal is not None:
                self._not_recorded(self._refusal)
            else:
                delay_s = self._recorder_backoff.again(self._follow_recorder)
                if delay_s is not None:
                    self.warned(f"{trouble}; another went on where it stopped")
                    return
                self._not_recorded(f"{trouble}, again and again")
            self._retire_spare()
            self._recording = False
            if self._stream is not None and not self._stream.ended:
                self._stream.stop()
            self._settle()
        self._reconstructions.look_again()

    def _follow_recorder(self) -> None:
        with self._lock:
            if self._closing or not self._recording:
                return
            spare, self._spare = self._spare, None
            # One that was killed before it had begun leaves nothing to go on with.
            begun = self._folder.recording(self.id).with_suffix(".json").exists()
            self._start_recorder(spare, resume=begun)

    def _retire_spare(self) -> None:
        spare, self._spare = self._spare, None
        if spare is not None:
            spare.dismiss()

    def _recorded(self, account: RecordingEnded) -> None:
        recording = Recorded(account.frames, account.bytes, lost=sum(account.lost.values()))
        verdict = judged(account)
        self._set(recording=recording, verdict=verdict)
        if account.trouble:
            self._announce.log("error", account.trouble, self.id)
            if verdict.grade is Grade.BAD:
                self._fail(account.trouble)
            elif not self._row.reason:
                self._set(reason=account.trouble)

    def _not_recorded(self, reason: str) -> None:
        """What was written before stays: its recorder can have died with the ring, behind which nothing can be read."""
        self._fail(reason)
        recording, verdict = salvaged(self._folder.recording(self.id), reason)
        self._set(recording=recording, verdict=verdict)
        if self._stream is not None:
            self._stream.bury(Role.RECORDER)

    def _reconstruction_ended(self, row: ReconstructionRow) -> None:
        with self._lock:
            self._reconstructing = False
            if self._stream is not None:
                self._stream.bury(Role.RECONSTRUCTION)
            if row.state is JobState.QUEUED:
                self.warned(row.reason)
            elif row.state is JobState.FAILED:
                if self._row.plan.record:
                    self.warned(row.reason)
                else:
                    self._fail(row.reason)
                    if self._stream is not None:
                        self._stream.stop()
            self._settle()

    def _settle(self) -> None:
        """Over, once nothing acquires, records, or reconstructs."""
        if self._stream is None or not self._stream.settled or self._recording or self._reconstructing:
            return
        if self._over.is_set() or (self._closing and self._recorder is not None):
            return
        counters = self._stream.counters()
        self._stream.release()
        if self._closing and not self._row.reason:
            self._set(reason="ended, because the service was")
        state = CaptureState.FAILED if self._failed else CaptureState.COMPLETE
        self._set(state=state, counters=counters, ended_at=datetime.now(UTC))
        self._over.set()
        self._on_change(self)
        self._reconstructions.look_again()

    def _fail(self, reason: str) -> None:
        """The first trouble is the reason that counts."""
        self._failed = True
        self._announce.log("error", reason, self.id)
        if not self._row.reason:
            self._set(reason=reason)

    def _set(self, **fields: object) -> None:
        with self._lock:
            self._row = replace(self._row, **fields)  # type: ignore[arg-type]
            self.save()
        self._on_change(self)

    def save(self) -> bool:
        """Write the row down; false if the disk did not take it, which is tried again later."""
        try:
            self._catalogue.captures.put(self._row)
        except StoreError as error:
            self._announce.log("error", str(error), self.id)
            return False
        return True
