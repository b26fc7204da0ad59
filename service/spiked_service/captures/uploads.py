"""Uploads of recordings: chunks are appended to a file and synced to disk before they are confirmed."""

import json
import os
import shutil
import threading
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from fastapi.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException

from spiked.camera import StoredCameraOptions
from spiked.errors import RecordingError, SpikedError
from spiked.recording import sidecar_path
from spiked.recording.sidecar import Sidecar
from spiked.whole_files import write_atomically
from spiked_service.base.ids import new_id
from spiked_service.captures.captures import Captures
from spiked_service.conversion.form import Form
from spiked_service.store.catalogue import Catalogue, StoreError
from spiked_service.store.disk_space import DiskFullError, DiskSpace
from spiked_service.store.folder import UPLOAD_SUFFIXES, DataFolder
from spiked_service.store.rows import CaptureRow, CaptureState, Grade, Origin, Plan, Quality, Recorded, UploadRow
from spiked_service.workers.messages import UploadChecked, UploadCommand, UploadConverts, WorkerError, WorkerEvent
from spiked_service.workers.process import WorkerProcess
from spiked_service.workers.roles.recorder import CALIBRATION

_WRITE_BYTES = 1 << 20
"""Most bytes per write."""
_CHECK_S = 3600.0
"""Time for the check of an upload."""
_EXIT_S = 1.0
"""Time for a worker to exit; later it is killed."""


class UploadError(SpikedError):
    """A chunk or an upload does not match the announced size or state."""


class UploadOffsetError(UploadError):
    """A chunk does not start at the end of the previous one."""

    def __init__(self, message: str, offset_bytes: int) -> None:
        super().__init__(message)
        self.offset_bytes = offset_bytes


class UploadTooLargeError(UploadError):
    """The upload is larger than `limit_upload_bytes`."""


class UploadBusyError(UploadError):
    """Another request uses the same upload."""


class Uploads:
    """Stores uploads and makes captures of them. Thread-safe; `append` is called from an event loop."""

    def __init__(
        self, folder: DataFolder, catalogue: Catalogue, disk_space: DiskSpace, limit_bytes: Callable[[], int]
    ) -> None:
        """`limit_bytes` returns the current maximum size of a recording."""
        self._disk_space = disk_space
        self._limit_bytes = limit_bytes
        self._folder = folder
        self._catalogue = catalogue
        self._lock = threading.Lock()
        self._busy: set[str] = set()

    def create(
        self,
        name: str,
        notes: str,
        size: int,
        sidecar: str | None,
        geometry: str | None,
        sha256: str | None,
        form: Form | None = None,
        array: str | None = None,
        calibration: Path | None = None,
    ) -> UploadRow:
        """Create an upload of `size` bytes and reserve the space. Raises UploadTooLargeError, DiskFullError.

        `form` and `array` as for `read_content`. `calibration` is a file of this machine, which is copied.
        """
        if size > self._limit_bytes():
            raise UploadTooLargeError(f"{size} bytes exceed the limit of {self._limit_bytes()} for an upload")
        now = datetime.now(UTC)
        camera = json.loads(geometry) if geometry else None
        stated = json.dumps({"notes": notes, "geometry": camera, "form": form, "array": array})
        row = UploadRow(new_id(), name, size, now, now, sidecar=sidecar, geometry=stated, sha256=sha256)
        with self._disk_space.for_upload(size):
            with _store_errors(row.id):
                self._folder.upload(row.id).touch(mode=0o600)
                if calibration is not None:
                    shutil.copyfile(calibration, self._calibration(row.id))
            self._catalogue.uploads.put(row)
        return row

    def get(self, upload_id: str) -> UploadRow:
        """Raises UnknownIdError."""
        return self._catalogue.uploads.get(upload_id)

    def list(self) -> list[UploadRow]:
        """Uploads that are not captures yet, newest first."""
        return [row for row in self._catalogue.uploads.where("1 ORDER BY id DESC") if row.capture_id is None]

    async def calibrate(self, upload_id: str, chunks: AsyncIterator[bytes]) -> None:
        """Store the calibration of the camera, which is checked with the recording.

        Raises UnknownIdError, UploadError for a complete upload, UploadBusyError, StoreError.
        """
        row = await run_in_threadpool(self.get, upload_id)
        with self._exclusive(upload_id):
            if row.capture_id is not None:
                raise UploadError(f"upload {upload_id} is complete: it is capture {row.capture_id}")
            content = b"".join([chunk async for chunk in chunks])
            with _store_errors(upload_id):
                await run_in_threadpool(write_atomically, self._calibration(upload_id), content)

    async def append(
        self, upload_id: str, offset_bytes: int, chunks: AsyncIterator[bytes], length: int | None = None
    ) -> UploadRow:
        """Append a chunk at `offset_bytes`, of `length` bytes if that is known.

        Bytes received before an interruption are kept; a chunk that is too long is dropped. Raises UnknownIdError,
        UploadOffsetError, UploadError for more bytes than announced, UploadBusyError, StoreError.
        """
        row = await run_in_threadpool(self.get, upload_id)
        with self._exclusive(upload_id):
            if row.capture_id is not None:
                raise UploadError(f"upload {upload_id} is complete: it is capture {row.capture_id}")
            row = await run_in_threadpool(self.get, upload_id)
            if offset_bytes != row.offset_bytes:
                raise UploadOffsetError(
                    f"upload {upload_id} continues at byte {row.offset_bytes}, not {offset_bytes}", row.offset_bytes
                )
            if length is not None and offset_bytes + length > row.bytes:
                raise _too_much(row)
            file = await run_in_threadpool(_Tail, self._folder.upload(upload_id), row)
            try:
                async for chunk in chunks:
                    await run_in_threadpool(file.write, chunk)
            except (UploadError, HTTPException):  # longer than announced or than the limit of a request
                await run_in_threadpool(file.truncate)
                raise
            finally:
                # Also if the client has disconnected: bytes on disk need not be sent again.
                end = await run_in_threadpool(file.close)
                row = await run_in_threadpool(self._confirm, upload_id, end)
        return row

    def complete(self, upload_id: str, captures: Captures) -> UploadRow:
        """Verify a whole upload in a worker and make a capture of it. Does nothing to a completed upload.

        A file of another form is converted; then the upload itself is removed. Raises UnknownIdError, UploadError while
        bytes are missing, UploadBusyError, StoreError, DiskFullError if the recording does not fit, and RecordingError
        if it holds none: the upload is kept.
        """
        self.get(upload_id)
        with self._exclusive(upload_id):
            row = self.get(upload_id)
            if row.capture_id is not None:
                return row
            if row.offset_bytes != row.bytes:
                raise UploadError(f"{row.offset_bytes} of {row.bytes} bytes were received; send the rest first")
            stated = json.loads(row.geometry or "{}")
            calibration = self._calibration(upload_id)
            check = _Check(
                self._folder.upload(upload_id),
                row,
                stated,
                calibration if calibration.exists() else None,
                self._limit_bytes(),
                self._disk_space,
            )
            checked = check.run()
            lost = checked.lost
            recorded = Recorded(
                checked.frames, checked.bytes, lost=sum(lost.values()), lost_by_cause=lost, sha256=checked.sha256
            )
            verdict = Quality(Grade(checked.grade), checked.reasons)
            more = {"sensor": checked.sensor, "warnings": checked.warnings, "notes": stated.get("notes", "")}
            capture_id = self._move_to_capture(row, checked.converted, recorded, verdict, **more)
            captures.publish(capture_id)
            return self.get(upload_id)

    def remove(self, upload_id: str) -> None:
        """Remove an upload and its bytes; a capture made of it is kept. Raises UnknownIdError."""
        self.get(upload_id)
        with self._exclusive(upload_id):
            for suffix in UPLOAD_SUFFIXES:
                self._folder.upload(upload_id).with_suffix(suffix).unlink(missing_ok=True)
            self._catalogue.uploads.remove(upload_id)

    def _move_to_capture(
        self, upload: UploadRow, converted: bool, recorded: Recorded, verdict: Quality, **more: Any
    ) -> str:
        """Make a capture of an upload that was verified and has a sidecar, and return its id. Raises StoreError.

        `more` are further fields of the capture.
        """
        part = self._folder.upload(upload.id)
        now = datetime.now(UTC)
        row = CaptureRow(
            new_id(),
            Origin.UPLOAD,
            Plan(f"upload:{upload.name}", name=upload.name, reconstruct=False),
            CaptureState.COMPLETE,
            now,
            name=upload.name,
            recording=recorded,
            verdict=verdict,
            ended_at=now,
            **more,
        )
        data = self._folder.recording(row.id)
        files = {part.with_suffix(".dat") if converted else part: data, part.with_suffix(".json"): sidecar_path(data)}
        if self._calibration(upload.id).exists():
            files[self._calibration(upload.id)] = data.with_name(CALIBRATION)
        try:
            data.parent.mkdir()
            for own, there in files.items():
                _link(own, there)
            with self._catalogue.transaction():
                self._catalogue.captures.put(row)
                self._catalogue.uploads.set(upload.id, capture_id=row.id)
        except (OSError, StoreError) as error:
            for own, there in files.items():
                if there.exists() and not own.exists():
                    there.replace(own)
            self._folder.remove(data.parent)
            if isinstance(error, StoreError):
                raise
            raise StoreError(f"upload {upload.id} cannot be moved to its capture: {error.strerror}") from error
        for own in (*files, part):
            own.unlink(missing_ok=True)
        return row.id

    def _calibration(self, upload_id: str) -> Path:
        return self._folder.upload(upload_id).with_suffix(".npz")

    def _confirm(self, upload_id: str, offset_bytes: int) -> UploadRow:
        return self._catalogue.uploads.set(upload_id, offset_bytes=offset_bytes, updated_at=datetime.now(UTC))

    @contextmanager
    def _exclusive(self, upload_id: str) -> Iterator[None]:
        with self._lock:
            if upload_id in self._busy:
                raise UploadBusyError(f"another request is writing to upload {upload_id}; wait for its end")
            self._busy.add(upload_id)
        try:
            yield
        finally:
            with self._lock:
                self._busy.discard(upload_id)


def _link(own: Path, there: Path) -> None:
    """Give a file a second name, so that a kill loses none; move it where there are no links. Raises OSError."""
    try:
        there.hardlink_to(own)
    except OSError:
        own.replace(there)


class _Tail:
    """Appends to the file of an upload. Bytes after the confirmed offset, from a killed service, are cut off."""

    def __init__(self, path: Path, row: UploadRow) -> None:
        self._row = row
        self._id = row.id
        self._offset = row.offset_bytes
        with _store_errors(row.id):
            self._file = os.open(path, os.O_WRONLY)
            os.ftruncate(self._file, row.offset_bytes)
            os.lseek(self._file, row.offset_bytes, os.SEEK_SET)

    def write(self, chunk: bytes) -> None:
        if self._offset + len(chunk) > self._row.bytes:
            raise _too_much(self._row)
        view = memoryview(chunk)
        with _store_errors(self._id):
            while view:
                written = os.write(self._file, view[:_WRITE_BYTES])
                self._offset += written
                view = view[written:]

    def truncate(self) -> None:
        """Truncate the file to the confirmed offset."""
        with _store_errors(self._id):
            os.ftruncate(self._file, self._row.offset_bytes)
        self._offset = self._row.offset_bytes

    def close(self) -> int:
        """Sync the file and return its size."""
        try:
            with _store_errors(self._id):
                os.fsync(self._file)
        finally:
            with suppress(OSError):
                os.close(self._file)
        return self._offset


def _camera(stated: dict[str, Any]) -> StoredCameraOptions:
    """What was stated of the camera; earlier releases stored `frame_rate_hz`."""
    stated = {name: value for name, value in stated.items() if value is not None}
    if "frame_rate_hz" in stated:
        stated["rate"] = stated.pop("frame_rate_hz")
    return StoredCameraOptions.model_validate(stated)


def _too_much(row: UploadRow) -> UploadError:
    return UploadError(
        f"upload {row.id} was announced with {row.bytes} bytes and more were received; this chunk was dropped"
    )


class _Check:
    """Verifies and converts the file of an upload in a worker, so that the service never parses uploaded data."""

    def __init__(
        self,
        path: Path,
        row: UploadRow,
        stated: dict[str, Any],
        calibration: Path | None,
        limit_bytes: int,
        disk_space: DiskSpace,
    ) -> None:
        self._row = row
        self._disk_space = disk_space
        self._command = UploadCommand(
            path=path,
            sha256=row.sha256,
            sidecar=None if row.sidecar is None else Sidecar.model_validate_json(row.sidecar),
            camera=_camera(stated.get("geometry") or {}),
            form=stated.get("form"),
            array=stated.get("array"),
            calibration=calibration,
            limit_bytes=limit_bytes,
        )
        self._checked: UploadChecked | None = None
        self._reason: str | None = None
        self._full: DiskFullError | None = None
        self._over = threading.Event()

    def run(self) -> UploadChecked:
        """Raises UploadError, RecordingError, DiskFullError."""
        log = self._command.path.with_suffix(".log")
        worker = WorkerProcess(self._command, log, self._handle, self._on_exit)
        try:
            if not self._over.wait(_CHECK_S):
                raise UploadError(f"the check of upload {self._row.id} took more than {_CHECK_S:.0f} s; try again")
        finally:
            worker.dismiss()
            worker.kill_after(_EXIT_S)
            log.unlink(missing_ok=True)
            self._disk_space.release(self._command.converted)
            if self._checked is None:
                self._command.converted.unlink(missing_ok=True)
        if self._full is not None:
            raise self._full
        if self._checked is None:
            why = (self._reason or "its worker exited without output").replace(str(self._command.path), self._row.name)
            if self._command.calibration is not None:
                why = why.replace(str(self._command.calibration), "the calibration")
            raise RecordingError(f"upload {self._row.id} cannot be used as a recording: {why}")
        return self._checked

    def _handle(self, event: WorkerEvent) -> None:
        match event:
            case UploadConverts():
                try:
                    self._disk_space.reserve_converted(self._command.converted, event.bytes)
                except DiskFullError as error:
                    self._full = error
                    self._over.set()
            case UploadChecked():
                self._checked = event
            case WorkerError():
                self._reason = event.reason

    def _on_exit(self, reason: str | None) -> None:
        self._reason = self._reason or reason
        self._over.set()


@contextmanager
def _store_errors(upload_id: str) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise StoreError(
            f"upload {upload_id} cannot be written: {error.strerror}; free disk space and continue the upload"
        ) from error
