"""Images and statistics of a capture: of the newest frames, of recorded frames, or of its scene."""

import base64
import threading
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Header, Query, Request, Response
from fastapi.routing import APIRoute

from spiked.errors import ConfigurationError
from spiked.recording import open_recording
from spiked.whole_files import write_atomically
from spiked_service.api import files
from spiked_service.api.problems import NotReadyError, problems
from spiked_service.api.results import Result, Results
from spiked_service.api.routes.parameters import BINARY, NOT_MODIFIED, PICTURES, Column, Row, WishedImage
from spiked_service.api.schemas.base import IN_DIGITS, LARGEST_INTEGER
from spiked_service.api.schemas.captures import SpikesOut, StatsOut
from spiked_service.api.schemas.views import ViewRequest
from spiked_service.api.views import image_format, newest_frame, views_response
from spiked_service.captures.captures import Captures
from spiked_service.results.frame_images import (
    FrameWindow,
    Picture,
    PictureKind,
    frame_window_at,
    picture,
    spikes_of,
    statistics,
)
from spiked_service.results.image_encoding import ImageFormat, encode, thumbnail
from spiked_service.results.rate_statistics import Region, from_text, statistics_of
from spiked_service.results.view_renderer import ViewRenderer
from spiked_service.store.folder import DataFolder
from spiked_service.workers.messages import PreviewKind

Frame = Annotated[
    int | None,
    Query(ge=0, le=LARGEST_INTEGER, description="Absolute index of a recorded frame. Default: the newest frames."),
    IN_DIGITS,
]
Gain = Annotated[float, Query(ge=0.001, le=1000, description="Factor of the brightness.")]
White = Annotated[
    float | None,
    Query(
        ge=1e-6, le=1e6, description="Value shown as white. Default: determined from the image and returned in X-White."
    ),
]
Undistorted = Annotated[
    bool, Query(description="Without the distortion of the lens: of a recorded frame, or of the scene.")
]
OpticsOf = Annotated[
    str | None,
    Query(
        min_length=1,
        max_length=64,
        description="Reconstruction of this capture by whose optics a recorded image is undistorted. Default: those of "
        "the capture.",
    ),
]
OpticsVersion = Annotated[
    int | None,
    Query(ge=1, le=LARGEST_INTEGER, description="Version of `optics_of` that has these optics. Default: the newest."),
    IN_DIGITS,
]
Frames = Annotated[int, Query(ge=1, le=8192, description="Recorded frames to look at, around `frame`."), IN_DIGITS]
Side = Annotated[
    int | None, Query(ge=1, le=LARGEST_INTEGER, description="Of the region, pixels. Default: to the edge."), IN_DIGITS
]
_PICTURE: dict[int | str, dict[str, Any]] = {
    200: {"description": "The image; X-Frame is its middle frame.", "content": PICTURES},
    **problems(404),
}
_THUMBNAIL: dict[int | str, dict[str, Any]] = {
    200: {"description": "The image.", "content": {"image/webp": BINARY}},
    **NOT_MODIFIED,
    **problems(404),
}


def preview_routes(
    captures: Captures, folder: DataFolder, results: Results, views: ViewRenderer, route_class: type[APIRoute]
) -> APIRouter:
    """Preview, thumbnail and statistics below `captures/ID`."""
    router = APIRouter(prefix="/captures/{capture_id:id}", tags=["captures"], route_class=route_class)
    drawing = threading.Lock()

    @router.get("/preview", responses=_PICTURE, response_class=Response)
    def get_preview(
        capture_id: str,
        kind: PictureKind = PictureKind.INTERVAL,
        frame: Frame = None,
        gain: Gain = 1.0,
        white: White = None,
        undistorted: Undistorted = False,
        optics_of: OpticsOf = None,
        optics_version: OpticsVersion = None,
        format: WishedImage = None,
        accept: Annotated[str, Header(include_in_schema=False)] = "",
    ) -> Response:
        """An image of the newest frames, of the frames around a recorded one, or of the scene from its pose."""
        requested = image_format(format, accept)
        if kind is PictureKind.RENDER:
            result = results.of(results.newest(capture_id))
            view = _view_at(result, frame, white, gain, undistorted)
            answer = views_response(result, view, requested, views)
            if view.camera is not None:
                answer.headers["X-Frame"] = str(view.camera.frame)
            return answer
        if frame is None and captures.get(capture_id).row.state.acquiring:
            if undistorted:
                raise ConfigurationError("the newest frames are shown as the lens images them; give a recorded frame")
            return _live_preview(captures, capture_id, PreviewKind(kind))
        window = _frame_window(captures, folder, capture_id, frame)
        lens = window.sensor.intrinsics if undistorted else None
        if undistorted and optics_of is not None:
            row = results.row(optics_of)
            if row.capture_id != capture_id:
                raise ConfigurationError(f"reconstruction {optics_of} is of capture {row.capture_id}, not of this one")
            lens = results.of(row, optics_version).published.camera or lens
        return _recorded_preview(picture(window, kind, white, lens), gain, requested)

    @router.get("/thumbnail", responses=_THUMBNAIL, response_class=Response)
    def get_thumbnail(capture_id: str, request: Request) -> Response:
        """A small image: the last preview, else of its recording."""
        row = captures.get(capture_id).row
        path = folder.thumbnail(capture_id)
        if not path.exists():
            if not row.state.over:
                raise NotReadyError(f"capture {capture_id} has no image yet")
            with drawing:
                if not path.exists():
                    window = _frame_window(captures, folder, capture_id, None)
                    write_atomically(path, thumbnail(picture(window, PictureKind.INTERVAL, None).image))
        return files.content(request, path.read_bytes(), "image/webp", files.etag(files.stamp(path)))

    _add_measurements(router, captures, folder)
    return router


def _add_measurements(router: APIRouter, captures: Captures, folder: DataFolder) -> None:
    """Routes of rates and of spikes."""

    @router.get("/stats", responses=problems(404))
    def get_stats(capture_id: str, region: Annotated[Region | None, Depends(_region)], frame: Frame = None) -> StatsOut:
        """Spike rates over a few frames, the newest or those around a recorded frame, of all pixels or of a region."""
        if frame is None and captures.get(capture_id).row.state.acquiring:
            taken = captures.picture(capture_id)
            if taken is None:
                raise NotReadyError(f"capture {capture_id} has no frames yet")
            return StatsOut.of(statistics_of(from_text(taken.counts), taken.counted, taken.frame, region))
        return StatsOut.of(statistics(_frame_window(captures, folder, capture_id, frame), region))

    @router.get("/spikes", responses=problems(404))
    def get_spikes(capture_id: str, x: Column, y: Row, frame: Frame = None, frames: Frames = 1024) -> SpikesOut:
        """When a pixel of a recording fired."""
        window = _frame_window(captures, folder, capture_id, frame)
        first, spikes = spikes_of(window, x, y, frames)
        return SpikesOut(first_frame=first, frames=min(frames, window.recording.frames), spikes=spikes)


def _region(x: Column = 0, y: Row = 0, width: Side = None, height: Side = None) -> Region | None:
    """The region that is asked for; None: all pixels."""
    return None if (x, y, width, height) == (0, 0, None, None) else Region(x, y, width, height)


def _live_preview(captures: Captures, capture_id: str, kind: PreviewKind) -> Response:
    """The newest image of the preview worker."""
    taken = captures.picture(capture_id)
    if taken is None:
        raise NotReadyError(f"capture {capture_id} has no image yet")
    return Response(
        base64.b64decode(taken.images[kind]), media_type="image/webp", headers=_headers(taken.white[kind], taken.frame)
    )


def _recorded_preview(shown: Picture, gain: float, requested: ImageFormat) -> Response:
    """An image of recorded frames."""
    limit = shown.white / gain
    return Response(
        encode(shown.image, requested, limit), media_type=requested.media_type, headers=_headers(limit, shown.frame)
    )


def _headers(white: float, frame: int) -> dict[str, str]:
    return {"X-White": repr(white), "X-Frame": str(frame), "Cache-Control": "no-store"}


def _view_at(result: Result, frame: int | None, white: float | None, gain: float, undistorted: bool) -> ViewRequest:
    """The view from the pose of a frame, of the newest pose if None."""
    pose = newest_frame(result) if frame is None else frame
    shown_white = (result.published.white if white is None else white) / gain
    return ViewRequest.model_validate({"camera": {"frame": pose}, "white": shown_white, "undistorted": undistorted})


def _frame_window(captures: Captures, folder: DataFolder, capture_id: str, frame: int | None) -> FrameWindow:
    """Recorded frames around `frame`. Raises UnknownIdError, NotReadyError without a recording."""
    row = captures.get(capture_id).row
    path = folder.recording(capture_id)
    if not path.exists():
        raise NotReadyError(f"capture {capture_id} has no recording")
    return frame_window_at(open_recording(path), frame, 0 if row.recording is None else row.recording.first_frame)
