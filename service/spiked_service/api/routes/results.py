"""Trajectory, scene and views of a reconstruction, below `reconstructions` and below `captures`."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Header, Query, Request, Response
from fastapi.routing import APIRoute

from spiked.scene_changes import FINEST
from spiked_service.api.auth.scopes import needs
from spiked_service.api.problems import problems
from spiked_service.api.results import Results, SceneFormat
from spiked_service.api.routes.parameters import (
    BINARY,
    ETAG,
    NOT_MODIFIED,
    PICTURES,
    Column,
    FromS,
    Row,
    ToS,
    Version,
    WishedImage,
)
from spiked_service.api.schemas.base import IN_DIGITS, LARGEST_INTEGER
from spiked_service.api.schemas.reconstructions import TrajectoryOut
from spiked_service.api.schemas.views import PointOut, ViewRequest
from spiked_service.api.trajectories import Range, TrajectoryFormat
from spiked_service.api.views import image_format, point_at, views_response
from spiked_service.reconstructions.repository import ReconstructionRepository
from spiked_service.results.view_renderer import ViewRenderer
from spiked_service.settings.tokens import Scope
from spiked_service.store.rows import ReconstructionRow

Step = Annotated[int, Query(ge=1, le=1_000_000, description="Every n-th pose."), IN_DIGITS]
PathNumber = Annotated[
    int,
    Query(ge=0, le=10_000, description="Of a map of several recordings, another one's path; `GET paths` lists them."),
    IN_DIGITS,
]
MaxSplats = Annotated[
    int | None,
    Query(ge=1, le=10_000_000, description="Most splats: a fixed sample is returned. Default: all."),
    IN_DIGITS,
]
Metric = Annotated[
    bool,
    Query(description="In metres, with up along -y, by the scale that is stored; 404 while there is none."),
]
Since = Annotated[
    str | None,
    Query(
        pattern=r"^[0-9]{1,10}-[0-9]{1,10}-[0-9]$",
        description="State of the answer before, `began-version-level`, to get what changed since. Default: all.",
    ),
]
Level = Annotated[
    int,
    Query(ge=0, le=FINEST, description="Level of detail: 0 has a sixteenth of the splats, 1 a quarter, 2 all."),
    IN_DIGITS,
]
PosedFrame = Annotated[
    int | None,
    Query(ge=0, le=LARGEST_INTEGER, description="Absolute index of a frame. Default: the newest that has a pose."),
    IN_DIGITS,
]

_TEXT: dict[str, Any] = {"schema": {"type": "string"}}
_VERSION: dict[str, Any] = {
    "X-Scene-Version": {"description": "Its version.", "schema": {"type": "integer"}},
    "X-Metres-Per-Unit": {
        "description": "Metres for the unit of its lengths, where known.",
        "schema": {"type": "number"},
    },
    "X-Scale-Sigma": {
        "description": "Relative standard deviation of that, where known.",
        "schema": {"type": "number"},
    },
}
_TRAJECTORY: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "The trajectory.",
        "headers": {**ETAG, **_VERSION},
        "content": {
            "application/json": {"schema": {"$ref": "#/components/schemas/TrajectoryOut"}},
            "text/plain": _TEXT,
            "application/vnd.nerfstudio+json": {"schema": {"type": "object", "additionalProperties": True}},
            "application/zip": BINARY,
        },
    },
    **NOT_MODIFIED,
    **problems(404),
}


def _binary(description: str) -> dict[int | str, dict[str, Any]]:
    """Responses of a route that sends bytes of a version, or a range of them."""
    content = {"application/octet-stream": BINARY}
    return {
        200: {"description": description, "headers": {**ETAG, **_VERSION}, "content": content},
        206: {"description": "The requested range.", "content": content},
        **NOT_MODIFIED,
        **problems(404, 416),
    }


_VIEWS: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "The image; for several views a ZIP of images and views.json.",
        "headers": _VERSION,
        "content": {**PICTURES, "application/zip": BINARY},
    },
    **problems(404),
}

_CHANGES_SAID = "The splats that visibly changed since an earlier answer; docs/api.md has the format."


@dataclass(frozen=True)
class _Operation:
    """Name and description of an operation in the OpenAPI document."""

    name: str
    description: str


@dataclass(frozen=True)
class _Operations:
    """Those of the results of a reconstruction."""

    trajectory: _Operation
    scene: _Operation
    changes: _Operation
    render: _Operation
    point: _Operation


def capture_result_routes(results: Results, views: ViewRenderer, route_class: type[APIRoute]) -> APIRouter:
    """Results of the newest reconstruction of a capture."""

    def newest(capture_id: str) -> ReconstructionRow:
        return results.newest(capture_id)

    return _result_routes(
        APIRouter(prefix="/captures/{capture_id:id}", tags=["captures"], route_class=route_class),
        newest,
        results,
        views,
        _Operations(
            trajectory=_Operation("get_trajectory", "The trajectory of its newest reconstruction."),
            scene=_Operation("get_scene", "The scene of its newest reconstruction; its ETag changes with the version."),
            changes=_Operation("get_scene_changes", _CHANGES_SAID),
            render=_Operation(
                "render_views",
                "Images of its newest reconstruction: from one camera, from several, or along the path.",
            ),
            point=_Operation("get_point", "Depth, opacity and rate that its scene has at a pixel of a frame."),
        ),
    )


def reconstruction_result_routes(
    rows: ReconstructionRepository, results: Results, views: ViewRenderer, route_class: type[APIRoute]
) -> APIRouter:
    """Results of a reconstruction."""

    def named(reconstruction_id: str) -> ReconstructionRow:
        return rows.get(reconstruction_id)

    return _result_routes(
        APIRouter(prefix="/reconstructions/{reconstruction_id:id}", tags=["reconstructions"], route_class=route_class),
        named,
        results,
        views,
        _Operations(
            trajectory=_Operation(
                "get_reconstruction_trajectory",
                "The trajectory of a version, or a part of it: JSON, TUM, KITTI, COLMAP or nerfstudio.",
            ),
            scene=_Operation(
                "get_reconstruction_scene",
                "The scene of a version as 3DGS PLY (RDF axes) or SPZ (RUB axes); X-White is the radiance of colour 1.",
            ),
            changes=_Operation("get_reconstruction_scene_changes", _CHANGES_SAID),
            render=_Operation(
                "render_reconstruction_views",
                "Images of a version: from one camera, from several, or along the path; colour, depth or alpha.",
            ),
            point=_Operation(
                "get_reconstruction_point", "Depth, opacity and rate that the scene has at a pixel of a frame."
            ),
        ),
    )


def _result_routes(
    router: APIRouter,
    find: Callable[..., ReconstructionRow],
    results: Results,
    views: ViewRenderer,
    operations: _Operations,
) -> APIRouter:
    """Add the routes to `router`; `find` takes the id in its path and returns the reconstruction."""
    _add_trajectory_route(router, find, results, operations.trajectory)
    _add_scene_routes(router, find, results, operations.scene, operations.changes)
    _add_view_routes(router, find, results, views, operations.render, operations.point)
    return router


def _add_trajectory_route(
    router: APIRouter, find: Callable[..., ReconstructionRow], results: Results, operation: _Operation
) -> None:
    @router.get(
        "/trajectory",
        name=operation.name,
        description=operation.description,
        responses=_TRAJECTORY,
        response_model=TrajectoryOut,
        response_class=Response,
    )
    def get_trajectory(
        request: Request,
        row: Annotated[ReconstructionRow, Depends(find)],
        format: TrajectoryFormat = TrajectoryFormat.JSON,
        version: Version = None,
        from_s: FromS = None,
        to_s: ToS = None,
        step: Step = 1,
        path: PathNumber = 0,
        metric: Metric = False,
    ) -> Response:
        result = results.of(row, version)
        result = result.metric() if metric else result
        return results.trajectory(request, result, format, Range(from_s, to_s, step), path)


def _add_scene_routes(
    router: APIRouter,
    find: Callable[..., ReconstructionRow],
    results: Results,
    scene: _Operation,
    changes: _Operation,
) -> None:
    @router.get(
        "/scene",
        name=scene.name,
        description=scene.description,
        responses=_binary("The scene."),
        response_class=Response,
    )
    def get_scene(
        request: Request,
        row: Annotated[ReconstructionRow, Depends(find)],
        format: SceneFormat = SceneFormat.PLY,
        version: Version = None,
        max_splats: MaxSplats = None,
        metric: Metric = False,
    ) -> Response:
        result = results.of(row, version)
        return results.scenes.response(request, result.metric() if metric else result, format, max_splats)

    @router.get(
        "/scene/changes",
        name=changes.name,
        description=changes.description,
        responses=_binary("The changes."),
        response_class=Response,
    )
    def get_scene_changes(
        request: Request,
        row: Annotated[ReconstructionRow, Depends(find)],
        version: Version = None,
        since: Since = None,
        level: Level = FINEST,
    ) -> Response:
        return results.scenes.changes(request, results.of(row, version), since, level)


def _add_view_routes(
    router: APIRouter,
    find: Callable[..., ReconstructionRow],
    results: Results,
    views: ViewRenderer,
    render: _Operation,
    point: _Operation,
) -> None:
    @router.post(
        "/views",
        name=render.name,
        description=render.description,
        responses=_VIEWS,
        response_class=Response,
        openapi_extra=needs(Scope.READ),
    )
    def render_views(
        row: Annotated[ReconstructionRow, Depends(find)],
        body: ViewRequest,
        format: WishedImage = None,
        version: Version = None,
        accept: Annotated[str, Header(include_in_schema=False)] = "",
    ) -> Response:
        return views_response(results.of(row, version), body, image_format(format, accept), views)

    @router.get("/point", name=point.name, description=point.description, responses=problems(404))
    def get_point(
        row: Annotated[ReconstructionRow, Depends(find)],
        x: Column,
        y: Row,
        frame: PosedFrame = None,
        version: Version = None,
    ) -> PointOut:
        return point_at(results.of(row, version), x, y, frame, views)
