"""Requested views of a scene, rendered and encoded: one image, or a ZIP of several; or one pixel, as numbers."""

import io
import json
import zipfile

import numpy as np
from fastapi import Response

from spiked.camera import Pinhole
from spiked.errors import ConfigurationError
from spiked.pose import quaternion
from spiked.poses import PoseFile
from spiked.render import Camera
from spiked.sensor import Intrinsics, Sensor
from spiked.spline import Waypoints
from spiked.trajectory import BRIDGED_S
from spiked_service.api.problems import NoPoseError, NotReadyError
from spiked_service.api.results import Result
from spiked_service.api.schemas.views import MAX_PIXELS, PathModel, PointOut, ViewRequest
from spiked_service.api.trajectories import Range
from spiked_service.results.image_encoding import ImageFormat, encode
from spiked_service.results.rate_statistics import NotInImageError
from spiked_service.results.view_renderer import Output, Pose, ViewRenderer, shown

SOLID = 0.5
"""Opacity from which a pixel shows a surface that has a depth."""


def views_response(result: Result, request: ViewRequest, kind: ImageFormat, renderer: ViewRenderer) -> Response:
    """One image, or a ZIP of several.

    Raises NotReadyError, NoPoseError, ConfigurationError, SceneError, OverloadedError.
    """
    camera = _camera(result.sensor, request)
    poses = _poses(result, request)
    if len(poses) * camera.width * camera.height > MAX_PIXELS:
        raise ConfigurationError(
            f"{len(poses)} views of {camera.width}x{camera.height} are more than {MAX_PIXELS} pixels; request fewer, "
            "or smaller ones"
        )
    white = result.published.white
    red, green, blue = (part * white for part in request.background)
    headers = {"X-Scene-Version": str(result.published.version), "Cache-Control": "no-store", **result.scale_headers}
    pictures = []
    for pose in poses:
        plane = shown(renderer.render(result.scene, camera, pose), request.output, (red, green, blue))
        limit = request.white or _white(request.output, white, plane)
        pictures.append((encode(plane, kind, limit), limit))
    if request.camera is not None:
        picture, limit = pictures[0]
        return Response(picture, media_type=kind.media_type, headers={**headers, "X-White": repr(limit)})
    listed = [
        {
            "file": f"{i:03d}.{kind}",
            "position": pose.centre.tolist(),
            "quaternion_wxyz": quaternion(pose.rotation).tolist(),
            "white": limit,
        }
        for i, (pose, (_, limit)) in enumerate(zip(poses, pictures, strict=True))
    ]
    content: dict[str, bytes | str] = {f"{i:03d}.{kind}": picture for i, (picture, _) in enumerate(pictures)}
    k = camera.intrinsics
    shown_by = Pinhole.of(k)
    optics = None if shown_by is None else shown_by.model_dump(mode="json")
    about = {"intrinsics": optics, "output": request.output, "views": listed}
    content["views.json"] = json.dumps(about, indent=1)
    return Response(_zip(content), media_type="application/zip", headers=headers)


def point_at(result: Result, x: int, y: int, frame: int | None, renderer: ViewRenderer) -> PointOut:
    """What the scene has at pixel (x, y) of a frame, by default of the newest with a pose.

    Raises as `views_response` does, and NotInImageError.
    """
    seen = result.camera
    if result.sensor is None:
        raise NotReadyError("the camera of this capture is not known yet")
    if seen is None:
        raise ConfigurationError("the optics of this capture are not known, so no pixel has a ray")
    if x >= seen.width or y >= seen.height:
        raise NotInImageError(f"there is no pixel {x}, {y} in {seen.width}x{seen.height} pixels")
    shown_frame = newest_frame(result) if frame is None else frame
    poses, rate = result.poses(), result.frame_rate_hz
    pose = _of_frame(poses, shown_frame, rate, result.published.poses > len(poses))
    # Of the whole image, because splats beside a smaller one would be projected less exactly.
    image = renderer.render(result.scene, seen, pose)
    opacity, depth = float(image.alpha[y, x]), float(image.depth[y, x])
    version, solid = result.published.version, opacity >= SOLID
    ray = seen.intrinsics.unproject(np.array([x + 0.5, y + 0.5]))
    scale = result.scale
    depth_m = depth * scale.metres_per_unit if solid and scale.metres_per_unit is not None else None
    return PointOut(
        version=version,
        frame=shown_frame,
        opacity=opacity,
        rate=np.ravel(image.values[y, x]).tolist(),
        depth=depth if solid else None,
        depth_m=depth_m,
        depth_m_sigma=None if depth_m is None or scale.scale_sigma is None else depth_m * scale.scale_sigma,
        position=(pose.centre + pose.rotation @ ray * depth).tolist() if solid else None,
    )


def newest_frame(result: Result) -> int:
    """The last frame that has a pose."""
    return round(result.poses().time_s(-1) * result.frame_rate_hz - 0.5)


def _white(output: Output, white: float, plane: np.ndarray) -> float:
    match output:
        case Output.COLOR:
            return white
        case Output.ALPHA:
            return 1.0
        case Output.DEPTH:
            return max(float(plane.max()), 1e-9)


def _camera(sensor: Sensor | None, request: ViewRequest) -> Camera:
    if sensor is None and (request.width is None or request.intrinsics is None):
        raise NotReadyError("the camera of this capture is not known yet; give width, height and intrinsics")
    width = request.width or (sensor.width if sensor else 0)
    height = request.height or (sensor.height if sensor else 0)
    if request.intrinsics is not None:
        return Camera(_lens(request.intrinsics.intrinsics(), request), width, height)
    if sensor is None or sensor.intrinsics is None:
        raise ConfigurationError("the optics of this capture are not known; give intrinsics")
    k, scale = sensor.intrinsics, width / sensor.width
    cy = scale * k.cy + (height - scale * sensor.height) / 2
    own = Intrinsics(scale * k.fx, scale * k.fy, scale * k.cx, cy, k.distortion)
    return Camera(_lens(own, request), width, height)


def _lens(intrinsics: Intrinsics, request: ViewRequest) -> Intrinsics:
    return intrinsics.pinhole if request.undistorted else intrinsics


def _poses(result: Result, request: ViewRequest) -> list[Pose]:
    cameras = [request.camera] if request.camera else request.cameras or []
    if request.path is None and all(camera.frame is None for camera in cameras):
        return [camera.pose() for camera in cameras]
    known = result.poses()
    if request.path is not None:
        return _along(known, request.path)
    rate, of_views = result.frame_rate_hz, result.published.poses > len(known)
    return [
        camera.pose() if camera.frame is None else _of_frame(known, camera.frame, rate, of_views) for camera in cameras
    ]


def _of_frame(poses: PoseFile, frame: int, rate: float, of_views: bool) -> Pose:
    """The pose of a frame; interpolated in a version that has only the poses of the views."""
    time_s = (frame + 0.5) / rate
    row = poses.nearest(time_s, 0.51 / rate)
    if row is not None:
        return _at(poses, row)
    after = poses.first_from(time_s)
    if of_views and 0 < after < len(poses):
        around = poses.trajectory(range(after - 1, after + 1))
        if around.times_s[1] - around.times_s[0] < BRIDGED_S:
            waypoints = Waypoints(around.times_s, around.rotations, around.centres)
            rotations, centres = waypoints.poses([time_s])
            return Pose(rotations[0], centres[0])
    first, last = (round(poses.time_s(row) * rate - 0.5) for row in (0, -1))
    raise NoPoseError(f"frame {frame} has no pose in this version; it has poses from {first} to {last}")


def _along(poses: PoseFile, path: PathModel) -> list[Pose]:
    part = Range(path.from_s, path.to_s, 1).of(poses)
    times = np.linspace(poses.time_s(part[0]), poses.time_s(part[-1]), path.count)
    return [_at(poses, min(poses.first_from(float(time_s)), part[-1])) for time_s in times]


def _at(poses: PoseFile, row: int) -> Pose:
    one = poses.trajectory(range(row, row + 1))
    return Pose(one.rotations[0], one.centres[0])


def _zip(content: dict[str, bytes | str]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name, body in content.items():
            archive.writestr(zipfile.ZipInfo(name), body)
    return buffer.getvalue()


def image_format(requested: ImageFormat | None, accept: str) -> ImageFormat:
    """By the query, else by the Accept header, else PNG."""
    return requested or ImageFormat.accepted(accept) or ImageFormat.PNG
