"""Captures: start, stop, name and remove them, and take away what was recorded and seen."""

import base64
from http import HTTPStatus
from typing import Annotated, Any

from fastapi import APIRouter, Header, Query, Request, Response
from fastapi.routing import APIRoute

from spiked.recording import open_recording
from spiked.recording.sidecar import sidecar_path
from spiked_service.api import files
from spiked_service.api.idempotency import IdempotencyKey
from spiked_service.api.problems import ConflictError, NothingError, NotReadyError, problems
from spiked_service.api.reconstructions import (
    BINARY,
    ETAG,
    NOT_MODIFIED,
    PICTURES,
    SCENE_RESPONSES,
    TRAJECTORY_RESPONSES,
    VIEW_RESPONSES,
    FromS,
    MaxSplats,
    Results,
    Step,
    ToS,
    Version,
    WishedImage,
)
from spiked_service.api.results import (
    Range,
    Result,
    SceneFormat,
    TrajectoryFormat,
    image_format,
    trajectory_response,
    views_response,
)
from spiked_service.api.schemas.base import LARGEST_INTEGER, Cursor, Limit
from spiked_service.api.schemas.captures import (
    CaptureChange,
    CaptureOut,
    CapturePage,
    CaptureRequest,
    StatsOut,
    VerdictOut,
)
from spiked_service.api.schemas.reconstructions import TrajectoryOut
from spiked_service.api.schemas.views import ViewRequest
from spiked_service.api.sources import Sources
from spiked_service.captures import Captures
from spiked_service.images import encode
from spiked_service.messages import PreviewKind
from spiked_service.pictures import PictureKind, Shot, picture, shot_at, statistics
from spiked_service.store.folder import DataFolder
from spiked_service.store.rows import CaptureState, Plan
from spiked_service.views import ViewRenderer

Frame = Annotated[
    int | None,
    Query(ge=0, le=LARGEST_INTEGER, description="Absolute index, from the recording; the newest frames if not given."),
]
Gain = Annotated[float, Query(ge=0.001, le=1000, description="Times as bright.")]
White = Annotated[
    float | None,
    Query(
        ge=1e-6, le=1e6, description="Value shown as white; if not given it is found in the picture, and X-White tells."
    ),
]
_LIVE = (CaptureState.STARTING, CaptureState.STREAMING)
_RECORDING_RESPONSES: dict[int | str, dict[str, Any]] = {
    200: {"description": "All of it.", "headers": ETAG, "content": {"application/octet-stream": BINARY}},
    206: {"description": "The range asked for.", "content": {"application/octet-stream": BINARY}},
    **NOT_MODIFIED,
    **problems(404, 409, 416),
}
_PICTURE_RESPONSES: dict[int | str, dict[str, Any]] = {
    200: {"description": "The picture; X-Frame is the frame in its middle.", "content": PICTURES},
    **problems(404),
}


def capture_routes(
    captures: Captures,
    sources: Sources,
    folder: DataFolder,
    results: Results,
    views: ViewRenderer,
    route_class: type[APIRoute],
) -> APIRouter:
    """Routes below `captures`. Plain functions: they run on threads, the event loop only passes requests on."""
    router = APIRouter(prefix="/captures", tags=["captures"], route_class=route_class)

    @router.post("", status_code=HTTPStatus.CREATED, responses=problems(404, 409, 507))
    def start_capture(
        body: CaptureRequest, request: Request, response: Response, idempotency_key: IdempotencyKey = None
    ) -> CaptureOut:
        """Start a capture; one at a time for each device."""
        plan = Plan(
            source=sources.named(body.source, body.device),
            frames=body.frames,
            seconds=body.seconds,
            pretrigger_s=body.pretrigger_s,
            name=body.name,
            notes=body.notes,
            record=body.record,
            reconstruct=body.reconstruct,
            options=body.options,
            intrinsics=body.intrinsics.intrinsics() if body.intrinsics else None,
        )
        snapshot = captures.start(plan)
        response.headers["Location"] = request.url_for("get_capture", capture_id=snapshot.row.id).path
        return CaptureOut.of(snapshot)

    @router.get("", responses=problems())
    def list_captures(
        limit: Limit = 50,
        cursor: Cursor = None,
        q: Annotated[str | None, Query(max_length=200, description="Looked for in name, notes and source.")] = None,
        state: CaptureState | None = None,
        deleted: Annotated[bool, Query(description="Those that were removed, instead.")] = False,
    ) -> CapturePage:
        """Captures, newest first."""
        page = captures.list(limit, cursor, q, state, deleted)
        items = [CaptureOut.of(captures.snapshot(row)) for row in page.items]
        return CapturePage(items=items, next_cursor=page.next_cursor)

    @router.get("/{capture_id:id}", responses=problems(404))
    def get_capture(capture_id: str) -> CaptureOut:
        """State, counters and recording of a capture."""
        return CaptureOut.of(captures.get(capture_id))

    @router.patch("/{capture_id:id}", responses=problems(404))
    def change_capture(capture_id: str, body: CaptureChange) -> CaptureOut:
        """Name it, note something, or keep it from being cleaned up."""
        captures.update(capture_id, name=body.name, notes=body.notes, keep=body.keep)
        return CaptureOut.of(captures.get(capture_id))

    @router.delete("/{capture_id:id}", status_code=HTTPStatus.NO_CONTENT, responses=problems(404, 409))
    def remove_capture(capture_id: str) -> None:
        """Remove it with all it has; `:restore` brings it back for some days."""
        captures.remove(capture_id)

    @router.post("/{capture_id:id}:restore", responses=problems(404, 409))
    def restore_capture(capture_id: str, idempotency_key: IdempotencyKey = None) -> CaptureOut:
        """Undo its removal."""
        captures.restore(capture_id)
        return CaptureOut.of(captures.get(capture_id))

    @router.post("/{capture_id:id}:stop", status_code=HTTPStatus.ACCEPTED, responses=problems(404))
    def stop_capture(capture_id: str, idempotency_key: IdempotencyKey = None) -> CaptureOut:
        """End the acquisition and refine what there is; asked again, end the refinement too."""
        captures.stop(capture_id)
        return CaptureOut.of(captures.get(capture_id))

    @router.head("/{capture_id:id}/recording", include_in_schema=False)
    @router.get("/{capture_id:id}/recording", responses=_RECORDING_RESPONSES, response_class=Response)
    def get_recording(capture_id: str, request: Request) -> Response:
        """The frames as one `.dat` file, or a range of its bytes."""
        _closed(capture_id)
        return files.ranged(request, folder.recording(capture_id), f"{capture_id}.dat")

    @router.get(
        "/{capture_id:id}/recording/sidecar",
        responses={
            200: {"description": "The sidecar.", "content": {"application/json": {"schema": {"type": "object"}}}},
            **NOT_MODIFIED,
            **problems(404, 409),
        },
        response_class=Response,
    )
    def get_sidecar(capture_id: str, request: Request) -> Response:
        """What the recording holds: the JSON that belongs beside the `.dat`."""
        _closed(capture_id)
        path = sidecar_path(folder.recording(capture_id))
        tag = files.etag(files.stamp(path))
        return files.content(request, path.read_bytes(), "application/json", tag, f"{capture_id}.json")

    @router.get("/{capture_id:id}/recording/verdict", responses=problems(404, 409))
    def get_verdict(capture_id: str) -> VerdictOut:
        """What the recording is good for, and why."""
        verdict = VerdictOut.of(captures.get(capture_id).row.verdict)
        if verdict is None:
            _closed(capture_id)
            raise NotReadyError(f"the recording of capture {capture_id} has not been judged yet")
        return verdict

    @router.get("/{capture_id:id}/preview", responses=_PICTURE_RESPONSES, response_class=Response)
    def get_preview(
        capture_id: str,
        kind: PictureKind = PictureKind.INTERVAL,
        frame: Frame = None,
        gain: Gain = 1.0,
        white: White = None,
        format: WishedImage = None,
        accept: Annotated[str, Header(include_in_schema=False)] = "",
    ) -> Response:
        """The newest frames as a picture, or those around a recorded frame; or what the scene looks like from there."""
        wished = image_format(format, accept)
        if kind is PictureKind.RENDER:
            result = _result(capture_id)
            camera = {"frame": _newest_pose(result) if frame is None else frame}
            shown_white = (result.published.white if white is None else white) / gain
            request = ViewRequest.model_validate({"camera": camera, "white": shown_white})
            return views_response(result, request, wished, views)
        if frame is None and captures.get(capture_id).row.state in _LIVE:
            return _live(capture_id, kind)
        shown = picture(_shot(capture_id, frame), kind, white)
        headers = {"X-White": repr(shown.white / gain), "X-Frame": str(shown.frame), "Cache-Control": "no-store"}
        return Response(encode(shown.image, wished, shown.white / gain), media_type=wished.media_type, headers=headers)

    @router.get(
        "/{capture_id:id}/thumbnail",
        responses={
            200: {"description": "A small picture.", "content": {"image/webp": BINARY}},
            **NOT_MODIFIED,
            **problems(404),
        },
        response_class=Response,
    )
    def get_thumbnail(capture_id: str, request: Request) -> Response:
        """A small picture of it."""
        captures.get(capture_id)
        path = folder.thumbnail(capture_id)
        if not path.exists():
            raise NotReadyError(f"capture {capture_id} has no picture yet")
        return files.content(request, path.read_bytes(), "image/webp", files.etag(files.stamp(path)))

    @router.get("/{capture_id:id}/stats", responses=problems(404))
    def get_stats(capture_id: str, frame: Frame = None) -> StatsOut:
        """How often pixels fire, over a few frames: the newest, or those around a recorded frame."""
        if frame is None and captures.get(capture_id).row.state in _LIVE:
            stats = captures.picture(capture_id)
            if stats is None:
                raise NotReadyError(f"capture {capture_id} has no frames yet")
            return StatsOut.of(stats)
        return StatsOut.of(statistics(_shot(capture_id, frame)))

    @router.get(
        "/{capture_id:id}/trajectory",
        responses=TRAJECTORY_RESPONSES,
        response_model=TrajectoryOut,
        response_class=Response,
    )
    def get_trajectory(
        capture_id: str,
        request: Request,
        format: TrajectoryFormat = TrajectoryFormat.JSON,
        version: Version = None,
        from_s: FromS = None,
        to_s: ToS = None,
        step: Step = 1,
    ) -> Response:
        """The trajectory of its newest reconstruction."""
        return trajectory_response(request, _result(capture_id, version), format, Range(from_s, to_s, step))

    @router.get("/{capture_id:id}/scene", responses=SCENE_RESPONSES, response_class=Response)
    def get_scene(
        capture_id: str,
        request: Request,
        format: SceneFormat = SceneFormat.PLY,
        version: Version = None,
        max_splats: MaxSplats = None,
    ) -> Response:
        """The scene of its newest reconstruction; its ETag changes with the version."""
        return results.scenes.response(request, _result(capture_id, version), format, max_splats)

    @router.post("/{capture_id:id}/views", responses=VIEW_RESPONSES, response_class=Response)
    def render_views(
        capture_id: str,
        body: ViewRequest,
        format: WishedImage = None,
        version: Version = None,
        accept: Annotated[str, Header(include_in_schema=False)] = "",
    ) -> Response:
        """Pictures of its newest reconstruction: from a camera, several, or along the path."""
        return views_response(_result(capture_id, version), body, image_format(format, accept), views)

    def _closed(capture_id: str) -> None:
        """Raises ConflictError while frames are being written, NotReadyError where there are none."""
        row = captures.get(capture_id).row
        if row.state in _LIVE:
            raise ConflictError(f"capture {capture_id} is being recorded; stop it, or wait for its end")
        if row.recording is None:
            raise NotReadyError(f"capture {capture_id} has no recording")

    def _shot(capture_id: str, frame: int | None) -> Shot:
        row = captures.get(capture_id).row
        path = folder.recording(capture_id)
        if not path.exists():
            raise NotReadyError(f"capture {capture_id} has no recording to look at")
        return shot_at(open_recording(path), frame, 0 if row.recording is None else row.recording.first_frame)

    def _result(capture_id: str, version: int | None = None) -> Result:
        capture = captures.get(capture_id)
        reconstructions = capture.reconstructions
        if not reconstructions and capture.row.state in _LIVE and capture.row.plan.reconstruct:
            raise NotReadyError(f"the reconstruction of capture {capture_id} has not begun yet")
        if not reconstructions:
            raise NothingError(f"capture {capture_id} has no reconstruction; POST reconstructions starts one")
        newest = next((row for row in reversed(reconstructions) if row.version), reconstructions[-1])
        return results.of(newest, version)

    def _newest_pose(result: Result) -> int:
        rate = 1.0 if result.sensor is None else result.sensor.frame_rate_hz
        return round(float(result.trajectory().times_s[-1]) * rate - 0.5)

    def _live(capture_id: str, kind: PictureKind) -> Response:
        taken, shown = captures.picture(capture_id), PreviewKind(kind)
        if taken is None:
            raise NotReadyError(f"capture {capture_id} has no picture yet")
        headers = {"X-White": repr(taken.white[shown]), "X-Frame": str(taken.frame), "Cache-Control": "no-store"}
        return Response(base64.b64decode(taken.images[shown]), media_type="image/webp", headers=headers)

    return router
