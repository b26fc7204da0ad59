"""The routes of captures: start, stop, look at, and take away what they have produced."""

import base64
from enum import StrEnum
from http import HTTPStatus
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from fastapi import APIRouter, Header, Request, Response

from spiked.errors import ConfigurationError
from spiked.pose import quaternion
from spiked.render import Camera
from spiked.trajectory import Trajectory
from spiked_service.api.old_schemas import CaptureOut, CaptureRequest, TrajectoryOut, ViewRequest
from spiked_service.api.problems import NotReadyError, Problem
from spiked_service.captures import Captures, unhurried
from spiked_service.images import ImageFormat, encode
from spiked_service.messages import PreviewKind
from spiked_service.publication import Published, newest
from spiked_service.reconstruction_options import ReconstructionOptions
from spiked_service.reconstructions import Reconstructions
from spiked_service.snapshot import Snapshot
from spiked_service.store.rows import Plan
from spiked_service.views import Pose, ViewRenderer


class TrajectoryFormat(StrEnum):
    """How a trajectory is written."""

    JSON = "json"
    TUM = "tum"


class SceneFormat(StrEnum):
    """How a scene is written."""

    PLY = "ply"


_Responses = dict[int | str, dict[str, Any]]

_PROBLEM: dict[str, Any] = {"model": Problem, "content": {"application/problem+json": {}}}
_NOT_FOUND: _Responses = {404: {**_PROBLEM, "description": "No such capture, or nothing there yet."}}
_PICTURES: dict[str, Any] = {"image/png": {}, "image/x-exr": {}}


def capture_routes(captures: Captures, reconstructions: Reconstructions, views: ViewRenderer) -> APIRouter:
    """Routes below `captures`. Plain functions: they run on threads, the event loop only passes requests on."""
    router = APIRouter(prefix="/captures", tags=["captures"])

    @router.post("", status_code=HTTPStatus.CREATED, responses={409: {**_PROBLEM, "description": "One is running."}})
    def start_capture(request: CaptureRequest, response: Response, http: Request) -> CaptureOut:
        """Start a capture and its reconstruction; one at a time."""
        plan = Plan(
            source=unhurried(request.source),
            frames=request.frames,
            seconds=request.seconds,
            options=ReconstructionOptions(seed=request.seed, steps=request.steps),
            intrinsics=request.intrinsics.intrinsics() if request.intrinsics else None,
        )
        capture = captures.start(plan)
        response.headers["Location"] = str(http.url_for("get_capture", capture_id=capture.id))
        return CaptureOut.shown(capture)

    @router.get("")
    def list_captures() -> list[CaptureOut]:
        """All captures since the service was started, oldest first."""
        return [CaptureOut.shown(captures.snapshot(row)) for row in reversed(captures.list().items)]

    @router.get("/{capture_id}", responses=_NOT_FOUND)
    def get_capture(capture_id: str) -> CaptureOut:
        """State, counters and reconstruction of a capture."""
        return CaptureOut.shown(captures.get(capture_id))

    @router.post("/{capture_id}:stop", status_code=HTTPStatus.ACCEPTED, responses=_NOT_FOUND)
    def stop_capture(capture_id: str) -> CaptureOut:
        """End the acquisition and refine what there is; asked again, end the refinement too."""
        capture = captures.stop(capture_id)
        return CaptureOut.shown(capture)

    @router.get("/{capture_id}/trajectory", responses=_NOT_FOUND, response_model=TrajectoryOut)
    def get_trajectory(
        capture_id: str,
        format: TrajectoryFormat = TrajectoryFormat.JSON,
        if_none_match: Annotated[str | None, Header()] = None,
    ) -> Response:
        """The newest trajectory, as JSON or as a TUM file."""
        capture = captures.get(capture_id)
        folder, published = _published(capture, reconstructions)
        etag = _etag(published, format)
        if if_none_match == etag["ETag"]:
            return Response(status_code=HTTPStatus.NOT_MODIFIED, headers=etag)
        path = folder / published.trajectory
        if format is TrajectoryFormat.TUM:
            return Response(path.read_bytes(), media_type="text/plain; charset=utf-8", headers=etag)
        body = _trajectory(path, published.version).model_dump_json()
        return Response(body, media_type="application/json", headers=etag)

    @router.get(
        "/{capture_id}/scene",
        responses={**_NOT_FOUND, 200: {"content": {"application/octet-stream": {}}}},
        response_class=Response,
    )
    def get_scene(
        capture_id: str,
        format: SceneFormat = SceneFormat.PLY,
        if_none_match: Annotated[str | None, Header()] = None,
    ) -> Response:
        """The newest scene as a 3DGS PLY; its ETag changes with the version."""
        capture = captures.get(capture_id)
        folder, published = _published(capture, reconstructions)
        etag = _etag(published, format)
        if if_none_match == etag["ETag"]:
            return Response(status_code=HTTPStatus.NOT_MODIFIED, headers=etag)
        headers = {**etag, "Content-Disposition": f'attachment; filename="{published.scene}"'}
        content = (folder / published.scene).read_bytes()
        return Response(content, media_type="application/octet-stream", headers=headers)

    @router.post(
        "/{capture_id}/views",
        responses={**_NOT_FOUND, 200: {"content": _PICTURES, "description": "The picture."}},
        response_class=Response,
    )
    def render_view(
        capture_id: str,
        request: ViewRequest,
        format: ImageFormat | None = None,
        accept: Annotated[str, Header()] = "image/png",
    ) -> Response:
        """The newest scene from a pose, as PNG, or as EXR with radiance in spikes a frame."""
        capture = captures.get(capture_id)
        folder, published = _published(capture, reconstructions)
        kind = format or (ImageFormat.EXR if ImageFormat.EXR.media_type in accept else ImageFormat.PNG)
        rotation, centre = request.pose()
        image = views.render(folder / published.scene, _camera(capture, request), Pose(rotation, centre))
        picture = encode(image.values, kind, request.white or published.white)
        return Response(picture, media_type=kind.media_type, headers={"X-Scene-Version": str(published.version)})

    @router.get(
        "/{capture_id}/preview",
        responses={**_NOT_FOUND, 200: {"content": {"image/webp": {}}}},
        response_class=Response,
    )
    def get_preview(capture_id: str) -> Response:
        """The newest frames as a picture, WebP."""
        captures.get(capture_id)
        picture = captures.picture(capture_id)
        if picture is None:
            raise NotReadyError(f"capture {capture_id} has no live picture yet; ask again in a moment")
        content = base64.b64decode(picture.images[PreviewKind.INTERVAL])
        return Response(content, media_type="image/webp", headers={"Cache-Control": "no-store"})

    return router


def _published(capture: Snapshot, reconstructions: Reconstructions) -> tuple[Path, Published]:
    for row in reversed(capture.reconstructions):
        folder = reconstructions.folder(row.id)
        published = newest(folder)
        if published is not None:
            return folder, published
    raise NotReadyError(f"capture {capture.id} has no trajectory yet; its reconstruction says how far it is")


def _etag(published: Published, kind: StrEnum) -> dict[str, str]:
    return {"ETag": f'"{published.version}-{kind}"', "Cache-Control": "no-cache"}


def _trajectory(path: Path, version: int) -> TrajectoryOut:
    trajectory = Trajectory.read_tum(path)
    return TrajectoryOut(
        version=version,
        times_s=np.round(trajectory.times_s, 9).tolist(),
        positions=trajectory.centres.tolist(),
        quaternions_wxyz=quaternion(trajectory.rotations).tolist(),
    )


def _camera(capture: Snapshot, request: ViewRequest) -> Camera:
    sensor = capture.row.sensor
    k = request.intrinsics.intrinsics() if request.intrinsics else None
    if sensor is None:
        raise NotReadyError(f"capture {capture.id} has not opened its source yet")
    k = k or sensor.intrinsics
    if k is None:
        raise ConfigurationError("the optics of this capture are not known; give intrinsics")
    return Camera(k, request.width or sensor.width, request.height or sensor.height)
