"""Uploads: recordings that are sent in chunks, verified in a worker, and made captures."""

from http import HTTPStatus
from pathlib import Path
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Header, Request, Response
from fastapi.routing import APIRoute

from spiked.camera import StoredCameraOptions
from spiked.profile import CameraProfile
from spiked_service.api.idempotency import IdempotencyKey
from spiked_service.api.problems import UnsupportedTypeError, problems
from spiked_service.api.schemas.captures import CaptureOut
from spiked_service.api.schemas.uploads import UploadOut, UploadRequest, UploadsOut
from spiked_service.api.sources import Sources
from spiked_service.captures.camera_profiles import CameraProfiles
from spiked_service.captures.captures import Captures
from spiked_service.captures.uploads import Uploads
from spiked_service.store.catalogue import UnknownIdError
from spiked_service.store.rows import UploadRow

_CHUNK = "application/octet-stream"
_PATCH_BODY = {
    "requestBody": {
        "required": True,
        "description": "The next bytes; a chunk may have any size up to the limit.",
        "content": {_CHUNK: {"schema": {"type": "string", "format": "binary"}}},
    }
}
_PUT_BODY: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "description": "The whole file, with a limit as for chunks.",
        "content": {_CHUNK: {"schema": {"type": "string", "format": "binary"}}},
    }
}
_OFFSET = {"Upload-Offset": {"description": "Bytes received.", "schema": {"type": "integer"}}}


def upload_routes(
    uploads: Uploads, captures: Captures, sources: Sources, profiles: CameraProfiles, route_class: type[APIRoute]
) -> APIRouter:
    """Routes below `uploads`."""
    router = APIRouter(prefix="/uploads", tags=["uploads"], route_class=route_class)

    @router.post("", status_code=HTTPStatus.CREATED, responses=problems(404, 409, 507))
    def create_upload(
        body: UploadRequest, request: Request, response: Response, idempotency_key: IdempotencyKey = None
    ) -> UploadOut:
        """Announce a recording; then PATCH its bytes in order and POST `:complete`."""
        camera, calibration = _camera(body, sources, profiles)
        row = uploads.create(
            body.name,
            body.notes,
            body.bytes,
            None if body.sidecar is None else body.sidecar.model_dump_json(),
            camera.model_dump_json(exclude_none=True) if camera.model_fields_set else None,
            body.sha256,
            body.form,
            body.array,
            calibration,
        )
        response.headers["Location"] = request.url_for("get_upload", upload_id=row.id).path
        return _out(row)

    @router.get("", responses=problems())
    def list_uploads() -> UploadsOut:
        """Uploads that are not captures yet, newest first."""
        return UploadsOut(items=[_out(row) for row in uploads.list()])

    @router.get(
        "/{upload_id:id}",
        responses={**problems(404), 200: {"headers": _OFFSET}},
    )
    def get_upload(upload_id: str, response: Response) -> UploadOut:
        """State of an upload; after an interruption continue at `offset_bytes`."""
        row = uploads.get(upload_id)
        response.headers["Upload-Offset"] = str(row.offset_bytes)
        return _out(row)

    _add_content_routes(router, uploads, captures)
    return router


def _add_content_routes(router: APIRouter, uploads: Uploads, captures: Captures) -> None:
    """Routes that append bytes to an upload, complete it and remove it."""

    @router.patch(
        "/{upload_id:id}",
        responses={**problems(404, 409, 415, 507), 200: {"headers": _OFFSET}},
        openapi_extra=_PATCH_BODY,
        dependencies=[Depends(_is_chunk)],
    )
    async def append_to_upload(
        upload_id: str,
        request: Request,
        response: Response,
        upload_offset: Annotated[int, Header(ge=0, le=2**53 - 1, description="Offset of the first byte of the body.")],
    ) -> UploadOut:
        """Append bytes. The response is sent when they are synced to disk."""
        length = request.headers.get("content-length", "")
        row = await uploads.append(
            upload_id, upload_offset, request.stream(), int(length) if length.isdigit() else None
        )
        response.headers["Upload-Offset"] = str(row.offset_bytes)
        return _out(row)

    @router.put(
        "/{upload_id:id}/calibration",
        status_code=HTTPStatus.NO_CONTENT,
        responses=problems(404, 409, 415, 507),
        openapi_extra=_PUT_BODY,
        dependencies=[Depends(_is_chunk)],
    )
    async def calibrate_upload(upload_id: str, request: Request) -> None:
        """Send the camera's calibration, an .npz of `spiked calibrate`; `:complete` checks it and keeps it."""
        await uploads.calibrate(upload_id, request.stream())

    @router.post("/{upload_id:id}:complete", status_code=HTTPStatus.CREATED, responses=problems(404, 409, 507))
    def complete_upload(
        upload_id: str, request: Request, response: Response, idempotency_key: IdempotencyKey = None
    ) -> CaptureOut:
        """Verify the upload in a worker process and make a capture of it. A second call returns the same capture."""
        row = uploads.complete(upload_id, captures)
        assert row.capture_id is not None
        response.headers["Location"] = request.url_for("get_capture", capture_id=row.capture_id).path
        return CaptureOut.of(captures.get(row.capture_id))

    @router.delete("/{upload_id:id}", status_code=HTTPStatus.NO_CONTENT, responses=problems(404, 409))
    def remove_upload(upload_id: str) -> None:
        """Remove an upload and its bytes; a capture made of it is kept."""
        uploads.remove(upload_id)


def _camera(body: UploadRequest, sources: Sources, profiles: CameraProfiles) -> tuple[StoredCameraOptions, Path | None]:
    """What is stated of the camera, completed by a profile, and the calibration of a device.

    Raises UnknownIdError for a device that is not there or has no profile.
    """
    stated = StoredCameraOptions() if body.geometry is None else body.geometry.options()
    size = body.sidecar is None
    if body.profile is not None:
        return body.profile.completed(stated, size=size), None
    if body.device is None:
        return stated, None
    device = next((one for one in sources.devices() if one.source == body.device), None)
    if device is None:
        raise UnknownIdError(f"there is no device {body.device}; GET devices lists them")
    profile = CameraProfile.read(profiles.file(device))
    return profile.completed(stated, size=size), profiles.calibration(device)


def _is_chunk(content_type: Annotated[str | None, Header(include_in_schema=False)] = None) -> None:
    if (content_type or "").partition(";")[0].strip().lower() not in (_CHUNK, "application/offset+octet-stream"):
        raise UnsupportedTypeError(f"the content type of a chunk is {_CHUNK}, not {content_type or 'missing'}")


def _out(row: UploadRow) -> UploadOut:
    return UploadOut.model_validate({name: getattr(row, name) for name in UploadOut.model_fields})
