"""`exports`: the formats of other programs, and the newest or any version in one of them."""

from collections.abc import Callable
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Depends, Query, Request, Response
from fastapi import Path as PathParameter
from fastapi.routing import APIRoute
from pydantic import Field

from spiked.export import KINDS, ExportOptions, find_kind
from spiked.export.source import KEY_VIEWS
from spiked.video.rate_pictures import WINDOW
from spiked_service.api.exports import Exports
from spiked_service.api.problems import problems
from spiked_service.api.results import Results
from spiked_service.api.routes.parameters import BINARY, ETAG, NOT_MODIFIED, FromS, ToS, Version
from spiked_service.api.schemas.base import IN_DIGITS, LARGEST_INTEGER
from spiked_service.api.schemas.exports import ExportFormatOut, ExportFormatsOut
from spiked_service.reconstructions.repository import ReconstructionRepository
from spiked_service.store.rows import ReconstructionRow

FormatName = Annotated[
    str,
    PathParameter(
        description="Name of a format.",
        json_schema_extra={"enum": [kind.name for kind in KINDS], "example": "mesh-glb"},
    ),
]
Views = Annotated[
    int,
    Query(ge=1, le=1000, description="Key views: poses of pictures, depth maps and points, evenly along the path."),
    IN_DIGITS,
]
Frames = Annotated[
    list[Annotated[int, Field(ge=0, le=LARGEST_INTEGER)]] | None,
    Query(max_length=100, description="Frames that key views are of, in place of `views`; may be given again."),
]
Undistorted = Annotated[bool, Query(description="Pictures, depth maps and cameras without the lens's distortion.")]
ExpectedDepth = Annotated[bool, Query(description="Mean depth of what a pixel shows; less exact than the median.")]
Resolution = Annotated[
    int, Query(ge=16, le=512, description="Voxels of a mesh along the longest side of the scene."), IN_DIGITS
]
Seconds = Annotated[
    float, Query(ge=0.1, le=1200, description="Length of a video; 36,000 pictures of 1000 x 1000 at most.")
]
Fps = Annotated[float, Query(ge=1, le=240, description="Pictures a second of a video.")]
Side = Annotated[
    int | None,
    Query(ge=16, le=8192, description="Pixels of a video, 4096 x 2304 at most. Default: of the sensor."),
    IN_DIGITS,
]
Along = Annotated[
    Literal["smooth", "recorded"],
    Query(description="A video follows the recorded path without its tremor, or as it is."),
]
Slower = Annotated[
    float | None,
    Query(ge=0.001, le=1e6, description="Seconds of video for a second of recording. Default: a video of 10 s."),
]
Window = Annotated[int, Query(ge=1, le=4096, description="Frames of a picture."), IN_DIGITS]
Compensated = Annotated[
    bool, Query(description="Add the pictures before and after to each, moved along the motion: less noise.")
]
_NUMBER = r"-?[0-9]+(\.[0-9]+)?"
_POSE = rf"{_NUMBER}(,{_NUMBER}){{6}}"
Through = Annotated[
    str | None,
    Query(
        pattern=rf"^{_POSE}(;{_POSE})+$",
        max_length=6000,
        description="Poses that a video goes through instead of along the path: x,y,z,qw,qx,qy,qz of each, separated "
        "by semicolons; camera to world, OpenCV axes.",
        examples=["0,0,0,1,0,0,0;0.1,0,0,1,0,0,0"],
    ),
]
Metric = Annotated[bool, Query(description="In metres, with up along -y; 404 while the scale is not known.")]

_HEADERS: dict[str, Any] = {
    **ETAG,
    "X-Scene-Version": {"description": "Its version.", "schema": {"type": "integer"}},
    "Content-Disposition": {"description": "With a file name.", "schema": {"type": "string"}},
}
_CONTENT: dict[str, Any] = {kind.sent_as: BINARY for kind in KINDS}
_FILE: dict[int | str, dict[str, Any]] = {
    200: {"description": "The file, or a ZIP of the folder.", "headers": _HEADERS, "content": _CONTENT},
    206: {"description": "The requested range.", "content": _CONTENT},
    **NOT_MODIFIED,
    **problems(404, 416, 503, 507),
}
_VIDEO: dict[int | str, dict[str, Any]] = {
    200: {"description": "The file.", "headers": ETAG, "content": {"video/mp4": BINARY}},
    206: {"description": "The requested range.", "content": {"video/mp4": BINARY}},
    **NOT_MODIFIED,
    **problems(404, 416, 503, 507),
}
_DESCRIPTION = (
    "in a format of another program; `GET exports` lists them. The file is made in a worker process, which takes "
    "seconds to minutes, and kept for a while. One is made at a time, and given up when its client hangs up."
)


def export_routes(
    rows: ReconstructionRepository, results: Results, exports: Exports, route_class: type[APIRoute]
) -> APIRouter:
    """The list of formats, and exports of reconstructions and of captures."""
    router = APIRouter(route_class=route_class)

    @router.get("/exports", tags=["reconstructions"], responses=problems())
    def list_export_formats() -> ExportFormatsOut:
        """The formats of other programs that results are exported in, and what each loses."""
        return ExportFormatsOut(formats=[ExportFormatOut.of(kind) for kind in KINDS])

    def named(reconstruction_id: str) -> ReconstructionRow:
        return rows.get(reconstruction_id)

    def newest(capture_id: str) -> ReconstructionRow:
        return results.newest(capture_id)

    _add(router, "/reconstructions/{reconstruction_id:id}", "get_reconstruction_export", named, exports)
    _add(router, "/captures/{capture_id:id}", "get_export", newest, exports)

    @router.get(
        "/captures/{capture_id:id}/recording/video", tags=["captures"], responses=_VIDEO, response_class=Response
    )
    def get_recording_video(
        request: Request,
        capture_id: str,
        slower: Slower = None,
        fps: Fps = 30.0,
        window: Window = WINDOW,
        compensate: Compensated = False,
        from_s: FromS = None,
        to_s: ToS = None,
    ) -> Response:
        """The recording in slow motion, an MP4; pictures whose frames were lost are black. Made in a worker process."""
        return exports.video(
            request,
            capture_id,
            slower=slower,
            fps=fps,
            window=window,
            compensated=compensate,
            begin_s=from_s or 0.0,
            end_s=to_s,
        )

    return router


def _add(router: APIRouter, prefix: str, name: str, find: Callable[..., ReconstructionRow], exports: Exports) -> None:
    """The route of an export; `find` takes the id in its path and returns the reconstruction."""
    of = "A version" if "reconstruction" in name else "The newest reconstruction"

    @router.get(
        f"{prefix}/exports/{{format}}",
        name=name,
        tags=[prefix.split("/")[1]],
        description=f"{of} {_DESCRIPTION}",
        responses=_FILE,
        response_class=Response,
    )
    def get_export(
        request: Request,
        row: Annotated[ReconstructionRow, Depends(find)],
        format: FormatName,
        version: Version = None,
        views: Views = KEY_VIEWS,
        undistorted: Undistorted = False,
        expected_depth: ExpectedDepth = False,
        resolution: Resolution = 256,
        seconds: Seconds = 10.0,
        fps: Fps = 30.0,
        width: Side = None,
        height: Side = None,
        along: Along = "smooth",
        through: Through = None,
        metric: Metric = False,
        frame: Frames = None,
    ) -> Response:
        depth: Literal["median", "expected"] = "expected" if expected_depth else "median"
        poses = () if through is None else tuple(tuple(map(float, one.split(","))) for one in through.split(";"))
        options = ExportOptions(
            views=views,
            undistorted=undistorted,
            depth=depth,
            resolution=resolution,
            seconds=seconds,
            pictures_a_second=fps,
            width=width,
            height=height,
            along=along,
            through=poses,
            frames=tuple(frame or ()),
        )
        return exports.response(request, row, find_kind(format), options, version=version, metric=metric)
