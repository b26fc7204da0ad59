"""Recovers what an earlier service left: interrupted captures, and files that have no catalogue row.

Files that cannot be recovered move to `lost+found`.
"""

from collections.abc import Callable, Iterable
from dataclasses import replace
from datetime import UTC, datetime

from spiked.errors import RecordingError, SpikedError
from spiked.recording import read_sidecar, sidecar_path
from spiked_service.base.ids import made_at
from spiked_service.captures.reconcile import Orphans, note_versions
from spiked_service.captures.recording_quality import reassess, recover_and_assess, write_missing_sidecar
from spiked_service.captures.states import CaptureEvent, next_state
from spiked_service.reconstructions.notifier import Notifier
from spiked_service.reconstructions.repository import ReconstructionRepository
from spiked_service.results.versions import is_whole, newest, versions
from spiked_service.store.catalogue import Catalogue
from spiked_service.store.folder import DataFolder
from spiked_service.store.rows import (
    CaptureRow,
    CaptureState,
    Grade,
    JobState,
    Origin,
    Plan,
    Quality,
    ReconstructionRow,
)
from spiked_service.store.snapshot import Snapshot

_Check = tuple[Callable[[str], None], str]
"""A check and the id of its capture, reconstruction or upload."""
_SERVICE_ENDED = "the service ended during the capture"
_KEPT = (
    "rebuilt from its recording: its notes are lost, and it is marked to be kept; clear the mark to let retention "
    "remove it"
)


class Recovery:
    """Checks every capture, reconstruction and upload once after the start; an error ends the check of one item."""

    def __init__(
        self,
        folder: DataFolder,
        catalogue: Catalogue,
        rows: ReconstructionRepository,
        notifier: Notifier,
        orphans: Orphans,
    ) -> None:
        """Create it before the first capture is started: captures that have not ended count as interrupted."""
        self._folder = folder
        self._catalogue = catalogue
        self._rows = rows
        self._notifier = notifier
        self._orphans = orphans
        over = tuple(str(state) for state in CaptureState if state.over)
        self._interrupted = {row.id: row for row in catalogue.captures.where("state NOT IN (?, ?)", over)}

    def run(self, closing: Callable[[], bool]) -> None:
        """Check what the queue depends on. If the service closes, the next start repeats it."""
        self._each([(self._recover_interrupted, one) for one in self._interrupted], closing)
        work: list[_Check] = []
        work += [(self._recover_capture, one) for one in self._orphans.captures]
        work += [(self._check_files, row.id) for row in self._catalogue.captures.where() if row.state.over]
        work += [(self._recover_reconstruction, one) for one in self._orphans.reconstructions]
        work += [(self._set_job_aside, one) for one in self._catalogue.lost_reconstructions()]
        work += [(self._set_upload_aside, one) for one in self._orphans.uploads]
        self._each(work, closing)

    def check_results(self, closing: Callable[[], bool]) -> None:
        """Check the versions of all reconstructions that have ended: a millisecond each, while the queue runs."""
        self._each([(self._check_versions, one) for one in self._catalogue.ended_reconstructions()], closing)

    def _each(self, work: Iterable[_Check], closing: Callable[[], bool]) -> None:
        for check, one in work:
            if closing():
                return
            try:
                check(one)
            except (SpikedError, OSError, ValueError) as error:
                self._notifier.log("error", f"{one} could not be checked and is unchanged: {error}")

    def _recover_interrupted(self, capture_id: str) -> None:
        """End a capture that ran when an earlier service ended, and recover its recording."""
        row = self._interrupted[capture_id]
        self._notifier.log("warning", "the service ended during this capture", capture_id)
        recording, verdict = row.recording, row.verdict
        if row.plan.record and (recording is None or verdict is None):  # its recorder had not ended
            recording, verdict = recover_and_assess(self._folder.recording(capture_id), _SERVICE_ENDED, row.sensor)
        row = self._catalogue.captures.set(
            capture_id,
            state=next_state(row.state, CaptureEvent.SERVICE_ENDED),
            reason=row.reason or _SERVICE_ENDED,
            recording=recording,
            verdict=verdict,
            ended_at=datetime.now(UTC),
        )
        self._notifier.capture(Snapshot(row, row.counters, self._rows.jobs_of(capture_id)))

    def _recover_capture(self, capture_id: str) -> None:
        path = self._folder.recording(capture_id)
        folder = self._folder.capture(capture_id)
        if path.exists() and path.stat().st_nlink > 1:
            self._folder.remove(folder)  # of an upload, whose own names its files still have
            return
        try:
            sidecar = read_sidecar(sidecar_path(path))
            recording, verdict, finished = reassess(path)
            ended_at = datetime.fromtimestamp(path.stat().st_mtime, UTC)
        except (RecordingError, OSError) as error:
            if folder.is_dir() and not any(one.is_file() for one in folder.rglob("*")):
                return  # a capture that had not started
            where = self._folder.set_aside(folder)
            message = f"capture {capture_id} has no catalogue row and cannot be read: it was moved to {where}: {error}"
            self._notifier.log("error", message, capture_id)
            return
        source = (sidecar.device or {}).get("source")
        row = CaptureRow(
            capture_id,
            Origin.RECOVERED,
            Plan(source if isinstance(source, str) else "unknown", name=sidecar.note, reconstruct=False),
            CaptureState.COMPLETE if finished else CaptureState.FAILED,
            made_at(capture_id),
            name=sidecar.note,
            keep=True,
            reason="" if finished else _SERVICE_ENDED,
            warnings=(_KEPT,),
            sensor=sidecar.sensor(),
            recording=recording,
            verdict=verdict,
            ended_at=ended_at,
        )
        self._catalogue.captures.put(row)
        message = (
            f"capture {capture_id} had no catalogue row: it was rebuilt from its recording of {recording.frames} frames"
        )
        self._notifier.log("warning", message, capture_id)

    def _check_files(self, capture_id: str) -> None:
        """Check that the recording of a row exists, with its sidecar."""
        row = self._catalogue.captures.find(capture_id)
        if row is None or row.recording is None or not row.recording.frames:
            return
        path = self._folder.recording(capture_id)
        if not path.exists():
            message = f"the recording {path} is missing"
            self._catalogue.captures.change(capture_id, lambda row: _without_recording(row, message))
            self._notifier.log("error", message, capture_id)
        elif row.sensor is not None and not sidecar_path(path).exists():
            write_missing_sidecar(path, row.sensor)
            recording, verdict, _ = reassess(path)
            message = "its sidecar was missing and was rebuilt"
            verdict = Quality(max(verdict.grade, Grade.DEGRADED, key=list(Grade).index), (*verdict.reasons, message))
            self._catalogue.captures.set(capture_id, recording=recording, verdict=verdict)
            self._notifier.log("warning", f"{path}: {message}", capture_id)

    def _recover_reconstruction(self, reconstruction_id: str) -> None:
        folder = self._folder.reconstruction(reconstruction_id)
        if folder.is_dir() and not any(folder.iterdir()):
            return  # a reconstruction that had not started
        where = self._folder.set_aside(folder)
        message = f"the capture of reconstruction {reconstruction_id} is unknown: it was moved to {where}"
        self._notifier.log("error", message, None, reconstruction_id)

    def _check_versions(self, reconstruction_id: str) -> None:
        """Check that the versions of an ended reconstruction are whole, and that the catalogue lists them."""
        row = self._catalogue.reconstructions.find(reconstruction_id)
        if row is None or not row.state.over:  # it was restarted or removed meanwhile
            return
        folder = self._folder.reconstruction(reconstruction_id)
        published = versions(folder)
        if not all(is_whole(folder, one) for one in published):
            self._forget_incomplete(row)
            published = versions(folder)
        if not note_versions(self._catalogue, reconstruction_id, published) and row.version:
            self._lose_result(row)

    def _forget_incomplete(self, row: ReconstructionRow) -> None:
        """Take versions from the list whose files are missing or damaged."""
        gone = self._rows.forget_incomplete(row.id)
        if not gone:
            return  # it is edited now, or whole again
        left = newest(self._folder.reconstruction(row.id))
        if left is not None and row.version in gone:
            self._catalogue.reconstructions.set(
                row.id, version=left.version, splats=left.splats, poses=left.poses, psnr_db=left.psnr_db
            )
        numbers = ", ".join(map(str, gone))
        message = f"files are missing or damaged, so that these versions are not listed any more: {numbers}"
        self._notifier.log("error", message, row.capture_id, row.id)

    def _set_job_aside(self, reconstruction_id: str) -> None:
        """Move a reconstruction away whose capture is missing."""
        row = self._catalogue.reconstructions.get(reconstruction_id)
        folder = self._folder.reconstruction(reconstruction_id)
        where = self._folder.set_aside(*(one for one in (folder,) if one.exists()))
        self._catalogue.reconstructions.remove(reconstruction_id)
        message = f"reconstruction {reconstruction_id} of missing capture {row.capture_id} was moved to {where}"
        self._notifier.log("error", message, None, reconstruction_id)

    def _lose_result(self, row: ReconstructionRow) -> None:
        """End a reconstruction as failed whose files are gone: it was deleted after the backup that was restored."""
        reason = "its files are gone: they were deleted after the catalogue that was restored"
        self._catalogue.reconstructions.set(row.id, state=JobState.FAILED, reason=reason, version=0)
        self._notifier.log("error", reason, row.capture_id, row.id)

    def _set_upload_aside(self, upload_id: str) -> None:
        part = self._folder.upload(upload_id)
        where = self._folder.set_aside(*sorted(part.parent.glob(f"{upload_id}.*")))
        self._notifier.log("error", f"upload {upload_id} has no catalogue row: it was moved to {where}")


def _without_recording(row: CaptureRow, message: str) -> CaptureRow:
    return replace(row, recording=None, verdict=Quality(Grade.BAD, (message,)), reason=row.reason or message)
