"""The recording of a capture: its frames, sidecar and quality."""

from typing import Any

from fastapi import APIRouter, Request, Response
from fastapi.routing import APIRoute

from spiked.recording import Recording, open_recording
from spiked.recording.sidecar import sidecar_path
from spiked_service.api import files
from spiked_service.api.problems import ConflictError, NotReadyError, problems
from spiked_service.api.routes.parameters import BINARY, ETAG, NOT_MODIFIED
from spiked_service.api.schemas.captures import VerdictOut
from spiked_service.captures.captures import Captures
from spiked_service.store.folder import DataFolder

_RECORDING: dict[int | str, dict[str, Any]] = {
    200: {"description": "The whole file.", "headers": ETAG, "content": {"application/octet-stream": BINARY}},
    206: {"description": "The requested range.", "content": {"application/octet-stream": BINARY}},
    **NOT_MODIFIED,
    **problems(404, 409, 416),
}
_SIDECAR: dict[int | str, dict[str, Any]] = {
    200: {"description": "The sidecar.", "content": {"application/json": {"schema": {"type": "object"}}}},
    **NOT_MODIFIED,
    **problems(404, 409),
}


def recording_routes(captures: Captures, folder: DataFolder, route_class: type[APIRoute]) -> APIRouter:
    """Routes below `captures/ID/recording`."""
    router = APIRouter(prefix="/captures/{capture_id:id}/recording", tags=["captures"], route_class=route_class)

    @router.get("", responses=_RECORDING, response_class=Response)
    def get_recording(capture_id: str, request: Request) -> Response:
        """The frames as one `.dat` file, or a range of its bytes."""
        _check_closed(captures, capture_id)
        return files.ranged(request, folder.recording(capture_id), f"{capture_id}.dat")

    @router.get("/sidecar", responses=_SIDECAR, response_class=Response)
    def get_sidecar(capture_id: str, request: Request) -> Response:
        """The sidecar of the recording: the JSON file beside the `.dat`."""
        _check_closed(captures, capture_id)
        path = sidecar_path(folder.recording(capture_id))
        tag = files.etag(files.stamp(path))
        return files.content(request, path.read_bytes(), "application/json", tag, f"{capture_id}.json")

    @router.get("/verdict", responses=problems(404, 409))
    def get_verdict(capture_id: str) -> VerdictOut:
        """Quality of the recording, with reasons."""
        verdict = VerdictOut.of(captures.get(capture_id).row.verdict)
        if verdict is None:
            _check_closed(captures, capture_id)
            raise NotReadyError(f"the recording of capture {capture_id} has not been checked yet")
        return verdict

    return router


def closed_recording(captures: Captures, folder: DataFolder, capture_id: str) -> Recording:
    """The whole recording of a capture. Raises ConflictError while it is written, NotReadyError without one."""
    _check_closed(captures, capture_id)
    return open_recording(folder.recording(capture_id))


def _check_closed(captures: Captures, capture_id: str) -> None:
    """Raises ConflictError while frames are being written, NotReadyError if there is no recording."""
    row = captures.get(capture_id).row
    if row.state.acquiring:
        raise ConflictError(f"capture {capture_id} is being recorded; stop it, or wait for its end")
    if row.recording is None:
        raise NotReadyError(f"capture {capture_id} has no recording")
