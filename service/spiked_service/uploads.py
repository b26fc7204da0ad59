"""Recordings on their way here: chunks appended to a file, each safe on disk before it is confirmed."""

import json
import os
import threading
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from fastapi.concurrency import run_in_threadpool

from spiked.errors import RecordingError, SpikedError
from spiked.recording.sidecar import Sidecar
from spiked_service.captures import Captures
from spiked_service.child import Child
from spiked_service.ids import new_id
from spiked_service.messages import News, Refused, StatedGeometry, UploadChecked, UploadOrder
from spiked_service.store.catalogue import Catalogue, StoreError
from spiked_service.store.folder import DataFolder
from spiked_service.store.rows import Grade, Judgement, Recorded, UploadRow

_RESERVE_BYTES = 256 << 20
"""What an upload leaves free on the disk for captures."""
_WRITE_BYTES = 1 << 20
_CHECK_S = 3600.0


class UploadError(SpikedError):
    """A chunk or an upload does not fit what was announced."""


class UploadOffsetError(UploadError):
    """A chunk does not begin where the last one ended."""

    def __init__(self, message: str, offset_bytes: int) -> None:
        super().__init__(message)
        self.offset_bytes = offset_bytes


class UploadTooLargeError(UploadError):
    """More than the settings allow."""


class UploadBusyError(UploadError):
    """Another request works on the same upload."""


class Uploads:
    """Takes recordings in. Methods may be called from any thread, `append` from an event loop."""

    def __init__(self, folder: DataFolder, catalogue: Catalogue, limit_bytes: Callable[[], int]) -> None:
        """`limit_bytes` tells how long a recording may be, now."""
        self._limit_bytes = limit_bytes
        self._folder = folder
        self._catalogue = catalogue
        self._lock = threading.Lock()
        self._busy: set[str] = set()

    def create(
        self, name: str, notes: str, size: int, sidecar: str | None, geometry: str | None, sha256: str | None
    ) -> UploadRow:
        """Announce a recording of `size` bytes. Raises UploadTooLargeError, StoreError if there is no room."""
        if size > self._limit_bytes():
            raise UploadTooLargeError(f"{size} bytes are more than the {self._limit_bytes()} that an upload may have")
        free = self._folder.space().free_bytes
        if size > free - _RESERVE_BYTES:
            raise StoreError(
                f"{size} bytes do not fit: the data folder's disk has {max(0, free - _RESERVE_BYTES)} bytes for uploads"
            )
        now = datetime.now(UTC)
        said = json.dumps({"notes": notes, "geometry": json.loads(geometry) if geometry else None})
        row = UploadRow(new_id(), name, size, now, now, sidecar=sidecar, geometry=said, sha256=sha256)
        with _told(row.id):
            self._folder.upload(row.id).touch(mode=0o600)
        self._catalogue.uploads.put(row)
        return row

    def get(self, upload_id: str) -> UploadRow:
        """Raises UnknownIdError."""
        return self._catalogue.uploads.get(upload_id)

    def list(self) -> list[UploadRow]:
        """Those that have not become captures, newest first."""
        return [row for row in self._catalogue.uploads.where("1 ORDER BY id DESC") if row.capture_id is None]

    async def append(self, upload_id: str, offset_bytes: int, chunks: AsyncIterator[bytes]) -> UploadRow:
        """Take a chunk that begins at `offset_bytes`; what came of it before an interruption counts.

        Raises UnknownIdError, UploadOffsetError, UploadError for more than announced, UploadBusyError, StoreError.
        """
        row = await run_in_threadpool(self.get, upload_id)
        with self._alone(upload_id):
            if row.capture_id is not None:
                raise UploadError(f"upload {upload_id} is complete: it is capture {row.capture_id}")
            row = await run_in_threadpool(self.get, upload_id)
            if offset_bytes != row.offset_bytes:
                raise UploadOffsetError(
                    f"upload {upload_id} goes on at byte {row.offset_bytes}, not {offset_bytes}", row.offset_bytes
                )
            file = await run_in_threadpool(_Tail, self._folder.upload(upload_id), row)
            try:
                async for chunk in chunks:
                    await run_in_threadpool(file.write, chunk)
            finally:
                # Also when the client has gone: what is on disk need not be sent again.
                end = await run_in_threadpool(file.close)
                row = await run_in_threadpool(self._reached, upload_id, end)
        return row

    def complete(self, upload_id: str, captures: Captures) -> UploadRow:
        """Check a whole upload in a worker and make a capture of it; one that was completed stays as it is.

        Raises UnknownIdError, UploadError while bytes are missing, UploadBusyError, StoreError, and RecordingError for
        what is no recording: the upload stays, and can be completed with another geometry.
        """
        self.get(upload_id)
        with self._alone(upload_id):
            row = self.get(upload_id)
            if row.capture_id is not None:
                return row
            if row.offset_bytes != row.bytes:
                raise UploadError(f"{row.offset_bytes} of {row.bytes} bytes have come; send the rest first")
            said = json.loads(row.geometry or "{}")
            checked = _checked(self._folder.upload(upload_id), row, said.get("geometry"))
            recorded = Recorded(checked.frames, checked.bytes, lost=checked.lost, sha256=checked.sha256)
            verdict = Judgement(Grade(checked.grade), checked.reasons)
            captures.adopt(row, checked.sensor, recorded, verdict, said.get("notes", ""))
            return self.get(upload_id)

    def remove(self, upload_id: str) -> None:
        """Forget an upload and what has come of it; the capture that it became stays. Raises UnknownIdError."""
        self.get(upload_id)
        with self._alone(upload_id):
            self._folder.upload(upload_id).unlink(missing_ok=True)
            self._folder.upload(upload_id).with_suffix(".json").unlink(missing_ok=True)
            self._catalogue.uploads.remove(upload_id)

    def _reached(self, upload_id: str, offset_bytes: int) -> UploadRow:
        return self._catalogue.uploads.set(upload_id, offset_bytes=offset_bytes, updated_at=datetime.now(UTC))

    @contextmanager
    def _alone(self, upload_id: str) -> Iterator[None]:
        with self._lock:
            if upload_id in self._busy:
                raise UploadBusyError(f"another request is writing to upload {upload_id}; wait for its end")
            self._busy.add(upload_id)
        try:
            yield
        finally:
            with self._lock:
                self._busy.discard(upload_id)


class _Tail:
    """The end of an upload's file. What lies beyond the confirmed offset is from a service that was killed."""

    def __init__(self, path: Path, row: UploadRow) -> None:
        self._id, self._limit = row.id, row.bytes
        self._offset = row.offset_bytes
        with _told(row.id):
            self._file = os.open(path, os.O_WRONLY)
            os.ftruncate(self._file, row.offset_bytes)
            os.lseek(self._file, row.offset_bytes, os.SEEK_SET)

    def write(self, chunk: bytes) -> None:
        if self._offset + len(chunk) > self._limit:
            raise UploadError(f"more bytes came than the {self._limit} that were announced for upload {self._id}")
        view = memoryview(chunk)
        with _told(self._id):
            while view:
                written = os.write(self._file, view[:_WRITE_BYTES])
                self._offset += written
                view = view[written:]

    def close(self) -> int:
        """Bring it to disk, and say how far it reaches."""
        try:
            with _told(self._id):
                os.fsync(self._file)
        finally:
            with suppress(OSError):
                os.close(self._file)
        return self._offset


def _checked(path: Path, row: UploadRow, geometry: dict[str, Any] | None) -> UploadChecked:
    """What a worker finds; in the service nobody looks into a file from elsewhere."""
    order = UploadOrder(
        path=path,
        sha256=row.sha256,
        sidecar=None if row.sidecar is None else Sidecar.model_validate_json(row.sidecar),
        geometry=StatedGeometry.model_validate(geometry or {}),
    )
    found: list[UploadChecked] = []
    refused: list[str] = []
    trouble: list[str | None] = []
    over = threading.Event()

    def hear(news: News) -> None:
        match news:
            case UploadChecked():
                found.append(news)
            case Refused():
                refused.append(news.reason)

    def ended(what: str | None) -> None:
        trouble.append(what)
        over.set()

    log = path.with_suffix(".log")
    child = Child(order, log, hear, ended)
    try:
        if not over.wait(_CHECK_S):
            child.dismiss()
            raise UploadError(f"the check of upload {row.id} took more than {_CHECK_S:.0f} s")
    finally:
        child.kill_after(1.0)
        log.unlink(missing_ok=True)
    if not found:
        why = (refused or [trouble[0] or "its worker left no word"])[0].replace(str(path), row.name)
        raise RecordingError(f"upload {row.id} cannot be used as a recording: {why}")
    return found[0]


@contextmanager
def _told(upload_id: str) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise StoreError(f"upload {upload_id} cannot be written: {error.strerror}; make room and send it on") from error
