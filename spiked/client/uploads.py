"""Uploads of recordings."""

import hashlib
import json
from collections.abc import Callable
from http import HTTPStatus
from pathlib import Path
from typing import BinaryIO

from spiked.client.connection import ApiError, Connection, plain
from spiked.client.models import CaptureOut, GeometryModel, ProfileModel, UploadOut
from spiked.errors import SpikedError

_CHUNK_BYTES = 8 << 20
"""Bytes of an upload in one request."""
_ARRAYS = (".npy", ".npz", ".h5", ".hdf5")
"""Names of files of arrays, which have no sidecar."""


class UploadMethods:
    """What `Spiked` does with recordings of this machine and of stores."""

    _connection: Connection

    def upload(
        self,
        path: Path | str,
        *,
        name: str | None = None,
        notes: str = "",
        geometry: GeometryModel | None = None,
        form: str | None = None,
        array: str | None = None,
        profile: ProfileModel | None = None,
        device: str | None = None,
        calibration: Path | str | None = None,
        progress: Callable[[int, int], None] | None = None,
    ) -> CaptureOut:
        """Send a recording, with the sidecar beside it if there is one; it becomes a capture.

        Other files with frames are converted: `form` is `usb`, `pcie`, `array` or `bits`, by default detected; `array`
        is the name of one of several arrays. `profile` says what `geometry` does not, or that of a `device`, whose
        calibration is used, too; `calibration` is a file of `spiked calibrate`.
        `progress` is told of bytes sent and bytes in all. A connection that breaks is taken up where it broke.
        """
        path = Path(path)
        recording = form in (None, "compact", "row_tagged") and path.suffix not in _ARRAYS
        beside = path.with_suffix(".json")
        with path.open("rb") as file:
            return self.upload_from(
                file,
                name or path.name,
                path.stat().st_size,
                sidecar=beside.read_bytes() if recording and beside.exists() else None,
                sha256=_sha256(path),
                notes=notes,
                geometry=geometry,
                form=form,
                array=array,
                profile=profile,
                device=device,
                calibration=calibration,
                progress=progress,
            )

    def upload_from(
        self,
        file: BinaryIO,
        name: str,
        size: int,
        *,
        sidecar: bytes | None = None,
        sha256: str | None = None,
        notes: str = "",
        geometry: GeometryModel | None = None,
        form: str | None = None,
        array: str | None = None,
        profile: ProfileModel | None = None,
        device: str | None = None,
        calibration: Path | str | None = None,
        progress: Callable[[int, int], None] | None = None,
    ) -> CaptureOut:
        """Send `size` bytes of a file that can be sought in, such as one of fsspec, which is read once, piece by piece.

        `sidecar` is the content of the file beside a recording. Else as `upload`.
        """
        body = {
            "name": name,
            "notes": notes,
            "bytes": size,
            "sidecar": None if sidecar is None else json.loads(sidecar),
            "geometry": plain(geometry),
            "sha256": sha256,
            "form": form,
            "array": array,
            "profile": plain(profile),
            "device": device,
        }
        upload = self._connection.post("uploads", body, UploadOut)
        if calibration is not None:
            content = Path(calibration).read_bytes()
            headers = {"Content-Type": "application/octet-stream"}
            self._connection.request("PUT", f"uploads/{upload.id}/calibration", content=content, headers=headers)
        while upload.offset_bytes < size:
            offset = file.seek(upload.offset_bytes)
            chunk = file.read(_CHUNK_BYTES)
            if not chunk:
                raise SpikedError(f"{name} became shorter than {size} bytes while it was sent; send it again")
            upload = self._send(upload, offset, chunk)
            if progress is not None:
                progress(upload.offset_bytes, size)
        return self._connection.post(f"uploads/{upload.id}:complete", None, CaptureOut)

    def _send(self, upload: UploadOut, offset: int, chunk: bytes) -> UploadOut:
        headers = {"Upload-Offset": str(offset), "Content-Type": "application/octet-stream"}
        try:
            answer = self._connection.request("PATCH", f"uploads/{upload.id}", content=chunk, headers=headers)
        except ApiError as error:
            if error.status != HTTPStatus.CONFLICT:
                raise
            # A chunk whose answer was lost had come all the same.
            now = self._connection.get(f"uploads/{upload.id}", UploadOut)
            if now.offset_bytes == offset:
                raise
            return now
        return UploadOut.model_validate_json(answer.content)


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
