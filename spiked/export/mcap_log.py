"""An MCAP file with Foxglove's schemas: path, pictures, depth maps and points at their times."""

import logging
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from spiked.export.images import png
from spiked.export.kind import ExportKind, optional
from spiked.export.source import ExportOptions, ExportSource
from spiked.export.timeline import (
    CAMERA,
    MAP,
    MAP_TO_WORLD_XYZW,
    POINT,
    WORLD,
    KeyFrame,
    Timeline,
    camera_message,
    read_timeline,
)
from spiked.whole_files import KeptErrors

__all__ = ["KIND"]

FISHEYE = "kannala_brandt"
"""Foxglove's name of the model."""
ORIGIN = (0.0, 0.0, 0.0)
"""No translation, in any unit."""


def fill(source: ExportSource, path: Path, options: ExportOptions) -> str:
    """Write a .mcap. Raises SceneError and ConfigurationError."""
    foxglove = optional("foxglove", "mcap")
    logging.getLogger("foxglove").setLevel(logging.WARNING)
    timeline = read_timeline(source, options)
    context = foxglove.Context()
    with KeptErrors(path) as file, foxglove.open_mcap(file, context=context) as writer:
        writer.write_metadata("scale", source.scale.texts)
        log = _Log(foxglove, context)
        log.begin(timeline)
        for row in range(len(timeline.stamps_ns)):
            log.pose(timeline, row)
        for key in timeline.keys:
            log.key(key)
            file.check()
    return timeline.said()


class _Log:
    """The topics of a file."""

    def __init__(self, foxglove: ModuleType, context: Any) -> None:
        self._m, channels = optional("foxglove.messages", "mcap"), optional("foxglove.channels", "mcap")
        self._transforms = channels.FrameTransformChannel("/tf", context=context)
        self._pose = channels.PoseInFrameChannel("/pose", context=context)
        self._path = channels.PosesInFrameChannel("/path", context=context)
        self._points = channels.PointCloudChannel("/points", context=context)
        self._calibration = channels.CameraCalibrationChannel("/camera/calibration", context=context)
        self._picture = channels.CompressedImageChannel("/camera/picture", context=context)
        self._depth = channels.RawImageChannel("/camera/depth", context=context)

    def begin(self, timeline: Timeline) -> None:
        """The axes, the whole path and the points, at the time of the first pose."""
        m, at = self._m, int(timeline.stamps_ns[0])
        self._transform(at, MAP, WORLD, ORIGIN, MAP_TO_WORLD_XYZW)
        poses = [self._posed(*pair) for pair in zip(timeline.centres, timeline.quats_xyzw, strict=True)]
        self._path.log(m.PosesInFrame(timestamp=self._stamp(at), frame_id=WORLD, poses=poses), log_time=at)
        kinds = {"<f4": m.PackedElementFieldNumericType.Float32, "|u1": m.PackedElementFieldNumericType.Uint8}
        fields = [
            m.PackedElementField(name=name, offset=POINT.fields[name][1], type=kinds[POINT.fields[name][0].str])
            for name in POINT.names or ()
            if POINT.fields is not None
        ]
        cloud = m.PointCloud(
            timestamp=self._stamp(at),
            frame_id=WORLD,
            pose=self._posed(ORIGIN, (0.0, 0.0, 0.0, 1.0)),
            point_stride=POINT.itemsize,
            fields=fields,
            data=timeline.point_table().tobytes(),
        )
        self._points.log(cloud, log_time=at)

    def pose(self, timeline: Timeline, row: int) -> None:
        """A pose of the camera."""
        at = int(timeline.stamps_ns[row])
        centre, quat = timeline.centres[row], timeline.quats_xyzw[row]
        self._transform(at, WORLD, CAMERA, centre, quat)
        pose = self._posed(centre, quat)
        self._pose.log(self._m.PoseInFrame(timestamp=self._stamp(at), frame_id=WORLD, pose=pose), log_time=at)

    def key(self, key: KeyFrame) -> None:
        """A picture with its camera and its depth map."""
        m, at, camera = self._m, key.stamp_ns, key.view.camera
        head: dict[str, Any] = {"timestamp": self._stamp(at), "frame_id": CAMERA}
        size = {"width": camera.width, "height": camera.height}
        optics = camera_message(camera, FISHEYE)
        calibration = m.CameraCalibration(
            **head,
            **size,
            distortion_model=optics.model,
            D=list(optics.d),
            K=list(optics.k),
            R=np.eye(3).reshape(-1).tolist(),
            P=list(optics.p),
        )
        self._calibration.log(calibration, log_time=at)
        self._picture.log(m.CompressedImage(**head, data=png(key.pixels), format="png"), log_time=at)
        depth = np.ascontiguousarray(key.view.depth, "<f4")
        raw = m.RawImage(**head, **size, encoding="32FC1", step=4 * camera.width, data=depth.tobytes())
        self._depth.log(raw, log_time=at)

    def _transform(self, at: int, parent: str, child: str, centre: Any, quat_xyzw: Any) -> None:
        names = {"parent_frame_id": parent, "child_frame_id": child}
        moved = {"translation": self._vector(centre), "rotation": self._quaternion(quat_xyzw)}
        self._transforms.log(self._m.FrameTransform(timestamp=self._stamp(at), **names, **moved), log_time=at)

    def _posed(self, centre: Any, quat_xyzw: Any) -> Any:
        return self._m.Pose(position=self._vector(centre), orientation=self._quaternion(quat_xyzw))

    def _vector(self, values: Any) -> Any:
        x, y, z = map(float, values)
        return self._m.Vector3(x=x, y=y, z=z)

    def _quaternion(self, xyzw: Any) -> Any:
        x, y, z, w = map(float, xyzw)
        return self._m.Quaternion(x=x, y=y, z=z, w=w)

    def _stamp(self, at: int) -> Any:
        return self._m.Timestamp(at // 10**9, at % 10**9)


KIND = ExportKind(
    name="mcap",
    title="MCAP with Foxglove schemas: path, pictures, depth maps, points",
    readers="Foxglove, Lichtblick, Rerun, mcap's libraries",
    loses="splats; transparency",
    suffix=".mcap",
    fill=fill,
    packages=("foxglove",),
    extra="mcap",
)
