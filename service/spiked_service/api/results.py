"""What a reconstruction has published, as it goes over HTTP: trajectory, scene, views."""

import io
import json
import threading
import zipfile
from collections import OrderedDict
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import numpy as np
from fastapi import Request, Response

from spiked import spz
from spiked.errors import ConfigurationError, SpikedError
from spiked.pose import quaternion
from spiked.render import Camera
from spiked.scene import Scene
from spiked.sensor import Intrinsics, Sensor
from spiked.trajectory import Trajectory
from spiked_service.api import files
from spiked_service.api.problems import GoneError, NoPoseError, NotReadyError
from spiked_service.api.schemas.reconstructions import TrajectoryOut
from spiked_service.api.schemas.views import MAX_PIXELS, CameraModel, PathModel, ViewRequest
from spiked_service.images import ImageFormat, encode
from spiked_service.publication import Published
from spiked_service.timeline import Timeline
from spiked_service.views import Output, Pose, ViewRenderer, shown

_ENCODED = 8
"""SPZ files and samples remembered, so that many viewers of one version cost one."""


class TrajectoryFormat(StrEnum):
    """How a trajectory is written."""

    JSON = "json"
    TUM = "tum"
    KITTI = "kitti"
    COLMAP = "colmap"
    """A ZIP of cameras.txt, images.txt and an empty points3D.txt, as COLMAP's text model."""
    NERFSTUDIO = "nerfstudio"


class SceneFormat(StrEnum):
    """How a scene is written."""

    PLY = "ply"
    SPZ = "spz"


TRAJECTORY_TYPES = {
    TrajectoryFormat.JSON: ("application/json", "json"),
    TrajectoryFormat.TUM: ("text/plain; charset=utf-8", "tum"),
    TrajectoryFormat.KITTI: ("text/plain; charset=utf-8", "kitti.txt"),
    TrajectoryFormat.COLMAP: ("application/zip", "colmap.zip"),
    TrajectoryFormat.NERFSTUDIO: ("application/vnd.nerfstudio+json", "transforms.json"),
}


@dataclass(frozen=True)
class Result:
    """A published version, and the camera that it comes from."""

    folder: Path
    published: Published
    sensor: Sensor | None
    timeline: Path

    @property
    def scene(self) -> Path:
        """The PLY file."""
        return self.folder / self.published.scene

    def trajectory(self) -> Trajectory:
        """Raises SceneError if the version has just gone."""
        return Trajectory.read_tum(self.folder / self.published.trajectory)


@dataclass(frozen=True)
class Range:
    """A part of a trajectory."""

    from_s: float | None
    to_s: float | None
    step: int

    def of(self, trajectory: Trajectory) -> Trajectory:
        """from_s <= time < to_s, every step-th pose. Raises NoPoseError if nothing is left."""
        begin = -np.inf if self.from_s is None else self.from_s
        part = trajectory.between(begin, np.inf if self.to_s is None else self.to_s)
        if len(part) == 0 and len(trajectory):
            raise NoPoseError(
                f"no pose lies in this range; there are poses from {trajectory.times_s[0]:.6f} "
                f"to {trajectory.times_s[-1]:.6f} s"
            )
        return Trajectory(part.times_s[:: self.step], part.rotations[:: self.step], part.centres[:: self.step])


def trajectory_response(request: Request, result: Result, kind: TrajectoryFormat, part: Range) -> Response:
    """The trajectory in one of the formats. Raises NotReadyError, NoPoseError, SceneError, ConfigurationError."""
    path = result.folder / result.published.trajectory
    stamp = files.stamp(path)
    tag = files.etag(result.published.version, kind, stamp, part.from_s, part.to_s, part.step)
    if files.unchanged(request, tag):
        return files.not_modified(tag)
    media_type, ending = TRAJECTORY_TYPES[kind]
    whole = part == Range(None, None, 1)
    if kind is TrajectoryFormat.TUM and whole:
        body = _read(path)
    else:
        body = _written(result, part.of(result.trajectory()), kind)
    version = {"X-Scene-Version": str(result.published.version)}
    return files.content(request, body, media_type, tag, f"trajectory.{ending}", **version)


def _written(result: Result, trajectory: Trajectory, kind: TrajectoryFormat) -> bytes:
    sensor = result.sensor
    match kind:
        case TrajectoryFormat.TUM:
            return trajectory.tum().encode()
        case TrajectoryFormat.KITTI:
            return trajectory.kitti().encode()
        case TrajectoryFormat.NERFSTUDIO:
            return trajectory.nerfstudio(_with_optics(sensor)).encode()
        case TrajectoryFormat.COLMAP:
            return _zip(trajectory.colmap_model(_with_optics(sensor)))
        case TrajectoryFormat.JSON:
            return _json(result, trajectory).model_dump_json().encode()


def _json(result: Result, trajectory: Trajectory) -> TrajectoryOut:
    rate = 1.0 if result.sensor is None else result.sensor.frame_rate_hz
    frames = np.round(trajectory.times_s * rate - 0.5).astype(np.int64)
    return TrajectoryOut(
        version=result.published.version,
        frames=frames.tolist(),
        times_s=np.round(trajectory.times_s, 9).tolist(),
        positions=trajectory.centres.tolist(),
        quaternions_wxyz=quaternion(trajectory.rotations).tolist(),
        states=list(Timeline.read(result.timeline).states_at(frames)),
    )


def _with_optics(sensor: Sensor | None) -> Sensor:
    if sensor is None or sensor.intrinsics is None:
        raise ConfigurationError("this format needs the optics, and those of this capture are not known; take tum")
    return sensor


class SceneFiles:
    """Scenes as files to be sent."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._encoded: OrderedDict[tuple[object, ...], bytes] = OrderedDict()

    def response(self, request: Request, result: Result, kind: SceneFormat, max_splats: int | None) -> Response:
        """The scene of a version; a fixed sample of it with max_splats. Raises NotReadyError, SceneError."""
        version = {"X-Scene-Version": str(result.published.version), "X-White": repr(result.published.white)}
        name = f"scene-{result.published.version:06d}.{kind}"
        if kind is SceneFormat.PLY and max_splats is None:
            return files.ranged(request, result.scene, name, **version)
        stamp = files.stamp(result.scene)
        tag = files.etag(result.published.version, kind, stamp, max_splats)
        if files.unchanged(request, tag):
            return files.not_modified(tag)
        key = (result.scene, stamp, kind, max_splats)
        with self._lock:
            body = self._encoded.get(key) or _encoded(result, kind, max_splats)
            self._encoded[key] = body
            self._encoded.move_to_end(key)
            if len(self._encoded) > _ENCODED:
                self._encoded.popitem(last=False)
        return files.content(request, body, "application/octet-stream", tag, name, **version)


def _encoded(result: Result, kind: SceneFormat, max_splats: int | None) -> bytes:
    scene, white = Scene.read_ply(result.scene), result.published.white
    if max_splats is not None:
        scene = scene.sample(max_splats)
    return spz.encode(scene, white) if kind is SceneFormat.SPZ else scene.ply(white)


def views_response(result: Result, request: ViewRequest, kind: ImageFormat, renderer: ViewRenderer) -> Response:
    """One picture, or a ZIP of several.

    Raises NotReadyError, NoPoseError, ConfigurationError, SceneError, OverloadedError.
    """
    camera = _camera(result.sensor, request)
    poses = _poses(result, request)
    if len(poses) * camera.width * camera.height > MAX_PIXELS:
        raise ConfigurationError(
            f"{len(poses)} views of {camera.width}x{camera.height} are more than {MAX_PIXELS} pixels; ask for fewer, "
            "or smaller ones"
        )
    white = result.published.white
    red, green, blue = (part * white for part in request.background)
    headers = {"X-Scene-Version": str(result.published.version), "Cache-Control": "no-store"}
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
    about = {"intrinsics": {"fx": k.fx, "fy": k.fy, "cx": k.cx, "cy": k.cy}, "output": request.output, "views": listed}
    content["views.json"] = json.dumps(about, indent=1)
    return Response(_zip(content), media_type="application/zip", headers=headers)


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
        return Camera(request.intrinsics.intrinsics(), width, height)
    if sensor is None or sensor.intrinsics is None:
        raise ConfigurationError("the optics of this capture are not known; give intrinsics")
    k, scale = sensor.intrinsics, width / sensor.width
    cy = scale * k.cy + (height - scale * sensor.height) / 2
    return Camera(Intrinsics(scale * k.fx, scale * k.fy, scale * k.cx, cy), width, height)


def _poses(result: Result, request: ViewRequest) -> list[Pose]:
    cameras = [request.camera] if request.camera else request.cameras or []
    if request.path is None and all(camera.frame is None for camera in cameras):
        return [camera.pose() for camera in cameras]
    trajectory = result.trajectory()
    if request.path is not None:
        return _along(trajectory, request.path)
    return [_pose(trajectory, result.sensor, camera) for camera in cameras]


def _pose(trajectory: Trajectory, sensor: Sensor | None, camera: CameraModel) -> Pose:
    if camera.frame is None:
        return camera.pose()
    rate = 1.0 if sensor is None else sensor.frame_rate_hz
    row = int(trajectory.nearest(np.array([(camera.frame + 0.5) / rate]), 0.51 / rate)[0])
    if row < 0:
        first, last = (round(float(t) * rate - 0.5) for t in trajectory.times_s[[0, -1]])
        raise NoPoseError(f"frame {camera.frame} has no pose in this version; it has poses from {first} to {last}")
    return Pose(trajectory.rotations[row], trajectory.centres[row])


def _along(trajectory: Trajectory, path: PathModel) -> list[Pose]:
    part = Range(path.from_s, path.to_s, 1).of(trajectory)
    times = np.linspace(part.times_s[0], part.times_s[-1], path.count)
    rows = np.clip(np.searchsorted(part.times_s, times), 0, len(part) - 1)
    return [Pose(part.rotations[row], part.centres[row]) for row in rows]


def _zip(content: dict[str, bytes | str]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name, body in content.items():
            archive.writestr(zipfile.ZipInfo(name), body)
    return buffer.getvalue()


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise GoneError(f"this version has just gone: {error.strerror}; ask for the newest") from error


def image_format(wished: ImageFormat | None, accept: str) -> ImageFormat:
    """By the query, else by the Accept header, else PNG."""
    return wished or ImageFormat.accepted(accept) or ImageFormat.PNG


__all__ = [
    "Range",
    "Result",
    "SceneFiles",
    "SceneFormat",
    "SpikedError",
    "TrajectoryFormat",
    "image_format",
    "trajectory_response",
    "views_response",
]
