"""Reconstructions: ask for one, follow it, end it, and take away what it has published."""

from dataclasses import replace
from http import HTTPStatus
from typing import Annotated, Any

from fastapi import APIRouter, Header, Query, Request, Response
from fastapi.responses import PlainTextResponse
from fastapi.routing import APIRoute

from spiked.sensor import Intrinsics
from spiked_service.api import files
from spiked_service.api.idempotency import IdempotencyKey
from spiked_service.api.problems import GoneError, NothingError, NotReadyError, problems
from spiked_service.api.results import (
    Range,
    Result,
    SceneFiles,
    SceneFormat,
    TrajectoryFormat,
    image_format,
    trajectory_response,
    views_response,
)
from spiked_service.api.schemas.base import LARGEST_INTEGER, Cursor, Limit
from spiked_service.api.schemas.reconstructions import (
    GapOut,
    ReconstructionOut,
    ReconstructionPage,
    ReconstructionRequest,
    RestartRequest,
    TimelineOut,
    TrajectoryOut,
    VersionOut,
    VersionsOut,
)
from spiked_service.api.schemas.views import ViewRequest
from spiked_service.captures import Captures
from spiked_service.images import ImageFormat
from spiked_service.publication import at
from spiked_service.reconstructions import Reconstructions
from spiked_service.store.rows import JobState, ReconstructionRow
from spiked_service.timeline import Timeline
from spiked_service.views import ViewRenderer

_LOG_BYTES = 1 << 20

Version = Annotated[
    int | None, Query(ge=1, le=LARGEST_INTEGER, description="The newest if not given; `GET versions` lists them.")
]
FromS = Annotated[float | None, Query(ge=0, le=1e9, description="First time, seconds since the start of the capture.")]
ToS = Annotated[float | None, Query(ge=0, le=1e9, description="Time where it ends, not included.")]
Step = Annotated[int, Query(ge=1, le=1_000_000, description="Every how manyth pose.")]
MaxSplats = Annotated[
    int | None, Query(ge=1, le=10_000_000, description="At most so many splats, a fixed sample; all if not given.")
]
WishedImage = Annotated[ImageFormat | None, Query(description="Wins over Accept; PNG if neither says.")]

BINARY: dict[str, Any] = {"schema": {"type": "string", "format": "binary"}}
TEXT: dict[str, Any] = {"schema": {"type": "string"}}
ETAG: dict[str, Any] = {"ETag": {"description": "Changes with the content.", "schema": {"type": "string"}}}
VERSION_HEADER: dict[str, Any] = {"X-Scene-Version": {"description": "Its version.", "schema": {"type": "integer"}}}
NOT_MODIFIED: dict[int | str, dict[str, Any]] = {304: {"description": "What you have is the newest."}}
_TRAJECTORY = {"schema": {"$ref": "#/components/schemas/TrajectoryOut"}}
TRAJECTORY_RESPONSES: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "The trajectory.",
        "headers": {**ETAG, **VERSION_HEADER},
        "content": {
            "application/json": _TRAJECTORY,
            "text/plain": TEXT,
            "application/vnd.nerfstudio+json": {"schema": {"type": "object", "additionalProperties": True}},
            "application/zip": BINARY,
        },
    },
    **NOT_MODIFIED,
    **problems(404),
}
SCENE_RESPONSES: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "The scene.",
        "headers": {**ETAG, **VERSION_HEADER},
        "content": {"application/octet-stream": BINARY},
    },
    206: {"description": "A part of it.", "content": {"application/octet-stream": BINARY}},
    **NOT_MODIFIED,
    **problems(404, 416),
}
PICTURES: dict[str, Any] = {kind.media_type: BINARY for kind in ImageFormat}
VIEW_RESPONSES: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "The picture; of several views a ZIP of pictures and views.json.",
        "headers": VERSION_HEADER,
        "content": {**PICTURES, "application/zip": BINARY},
    },
    **problems(404),
}


class Results:
    """Published versions by reconstruction."""

    def __init__(self, reconstructions: Reconstructions, captures: Captures) -> None:
        self._reconstructions = reconstructions
        self._captures = captures
        self.scenes = SceneFiles()

    def of(self, row: ReconstructionRow, version: int | None = None) -> Result:
        """A version of a reconstruction, the newest if none is named. Raises NotReadyError, NothingError, GoneError."""
        folder = self._reconstructions.folder(row.id)
        published = at(folder, version)
        if published is None and version is not None and version <= row.version:
            raise GoneError(f"version {version} of reconstruction {row.id} is not kept")
        if published is None:
            named = "" if version is None else f" {version}"
            if row.state.over:
                none = "has published nothing; :restart begins it again"
                some = f"has no version{named}; GET versions lists what it has"
                raise NothingError(f"reconstruction {row.id} is {row.state} and {some if row.version else none}")
            raise NotReadyError(f"reconstruction {row.id} has no version{named} yet; it is at stage {row.stage}")
        sensor = self._captures.get(row.capture_id).row.sensor
        if sensor is not None and published.intrinsics is not None:
            sensor = replace(sensor, intrinsics=Intrinsics(*published.intrinsics))
        return Result(folder, published, sensor, self._reconstructions.timeline(row.id))


def reconstruction_routes(
    reconstructions: Reconstructions, results: Results, views: ViewRenderer, route_class: type[APIRoute]
) -> APIRouter:
    """Routes below `reconstructions`. Plain functions: they run on threads."""
    router = APIRouter(prefix="/reconstructions", tags=["reconstructions"], route_class=route_class)

    @router.post("", status_code=HTTPStatus.ACCEPTED, responses=problems(404, 409, 507))
    def start_reconstruction(
        body: ReconstructionRequest, request: Request, response: Response, idempotency_key: IdempotencyKey = None
    ) -> ReconstructionOut:
        """Reconstruct a recording; it waits in line for those before it, and live captures go first."""
        row = reconstructions.submit(body.capture_id, body.options, body.priority)
        response.headers["Location"] = request.url_for("get_reconstruction", reconstruction_id=row.id).path
        return ReconstructionOut.of(row)

    @router.get("", responses=problems())
    def list_reconstructions(
        limit: Limit = 50,
        cursor: Cursor = None,
        capture_id: Annotated[str | None, Query(min_length=1, max_length=64)] = None,
        state: JobState | None = None,
    ) -> ReconstructionPage:
        """Reconstructions, newest first."""
        page = reconstructions.list(limit, cursor, capture_id, state)
        return ReconstructionPage(items=[ReconstructionOut.of(row) for row in page.items], next_cursor=page.next_cursor)

    @router.get("/{reconstruction_id:id}", responses=problems(404))
    def get_reconstruction(reconstruction_id: str) -> ReconstructionOut:
        """How far a reconstruction is."""
        return ReconstructionOut.of(reconstructions.get(reconstruction_id))

    @router.post("/{reconstruction_id:id}:cancel", status_code=HTTPStatus.ACCEPTED, responses=problems(404, 409))
    def cancel_reconstruction(reconstruction_id: str, idempotency_key: IdempotencyKey = None) -> ReconstructionOut:
        """End it; what it has published stays."""
        reconstructions.cancel(reconstruction_id)
        return ReconstructionOut.of(reconstructions.get(reconstruction_id))

    @router.post("/{reconstruction_id:id}:restart", status_code=HTTPStatus.ACCEPTED, responses=problems(404, 409))
    def restart_reconstruction(
        reconstruction_id: str, body: RestartRequest | None = None, idempotency_key: IdempotencyKey = None
    ) -> ReconstructionOut:
        """Begin anew from the recording, with other options if they are given; what was published goes."""
        reconstructions.restart(reconstruction_id, None if body is None else body.options)
        return ReconstructionOut.of(reconstructions.get(reconstruction_id))

    @router.delete("/{reconstruction_id:id}", status_code=HTTPStatus.NO_CONTENT, responses=problems(404, 409))
    def remove_reconstruction(reconstruction_id: str) -> None:
        """Remove it for good, with all it has published."""
        reconstructions.remove(reconstruction_id)

    @router.get(
        "/{reconstruction_id:id}/trajectory",
        responses=TRAJECTORY_RESPONSES,
        response_model=TrajectoryOut,
        response_class=Response,
    )
    def get_reconstruction_trajectory(
        reconstruction_id: str,
        request: Request,
        format: TrajectoryFormat = TrajectoryFormat.JSON,
        version: Version = None,
        from_s: FromS = None,
        to_s: ToS = None,
        step: Step = 1,
    ) -> Response:
        """The trajectory of a version, or a part of it: JSON, TUM, KITTI, COLMAP or nerfstudio."""
        result = results.of(reconstructions.get(reconstruction_id), version)
        return trajectory_response(request, result, format, Range(from_s, to_s, step))

    @router.get("/{reconstruction_id:id}/scene", responses=SCENE_RESPONSES, response_class=Response)
    def get_reconstruction_scene(
        reconstruction_id: str,
        request: Request,
        format: SceneFormat = SceneFormat.PLY,
        version: Version = None,
        max_splats: MaxSplats = None,
    ) -> Response:
        """The scene of a version as 3DGS PLY (RDF axes) or SPZ (RUB axes); X-White says the radiance of colour 1."""
        result = results.of(reconstructions.get(reconstruction_id), version)
        return results.scenes.response(request, result, format, max_splats)

    @router.post("/{reconstruction_id:id}/views", responses=VIEW_RESPONSES, response_class=Response)
    def render_reconstruction_views(
        reconstruction_id: str,
        body: ViewRequest,
        format: WishedImage = None,
        version: Version = None,
        accept: Annotated[str, Header(include_in_schema=False)] = "",
    ) -> Response:
        """Pictures of a version: from a camera, several, or along the path; colour, depth or alpha."""
        result = results.of(reconstructions.get(reconstruction_id), version)
        return views_response(result, body, image_format(format, accept), views)

    @router.get("/{reconstruction_id:id}/versions", responses=problems(404))
    def list_versions(reconstruction_id: str) -> VersionsOut:
        """The versions that are kept, oldest first."""
        reconstructions.get(reconstruction_id)
        return VersionsOut(items=[VersionOut.of(row) for row in reconstructions.versions(reconstruction_id)])

    @router.get("/{reconstruction_id:id}/timeline", responses=problems(404))
    def get_timeline(reconstruction_id: str) -> TimelineOut:
        """How it went: state, fit and loss over the frames."""
        reconstructions.get(reconstruction_id)
        timeline = Timeline.read(reconstructions.timeline(reconstruction_id))
        moments = timeline.moments
        return TimelineOut(
            time_s=[moment.time_s for moment in moments],
            frame=[moment.frame for moment in moments],
            state=[moment.state for moment in moments],
            chi2=[moment.chi2 for moment in moments],
            sigma_px=[moment.sigma_px for moment in moments],
            rate=[moment.rate for moment in moments],
            loss=[moment.loss for moment in moments],
            psnr_db=[moment.psnr_db for moment in moments],
            splats=[moment.splats for moment in moments],
            gaps=[GapOut(first=gap.first, count=gap.count, cause=gap.cause) for gap in timeline.gaps],
        )

    @router.get("/{reconstruction_id:id}/log", responses=problems(404), response_class=PlainTextResponse)
    def get_log(reconstruction_id: str, request: Request) -> Response:
        """The newest part of its log, as text."""
        reconstructions.get(reconstruction_id)
        path = reconstructions.log(reconstruction_id)
        if not path.exists():
            return PlainTextResponse("")
        stamp = files.stamp(path)
        with path.open("rb") as file:
            file.seek(max(0, path.stat().st_size - _LOG_BYTES))
            text = file.read(_LOG_BYTES).decode(errors="replace")
        return files.content(request, text.encode(), "text/plain; charset=utf-8", files.etag("log", stamp))

    return router
