"""An MP4 along the recorded path, without its tremor if wanted, or through poses that are chosen."""

from pathlib import Path

import numpy as np

from spiked.errors import ConfigurationError
from spiked.export.kind import ExportKind
from spiked.export.source import ExportOptions, ExportSource
from spiked.pose import rotation_of
from spiked.sensor import Sensor
from spiked.trajectory import Trajectory
from spiked.video import CameraPath, Mp4Writer, calm_path, recorded_path, scene_pictures, video_camera, waypoint_path
from spiked.video.limits import check_size

__all__ = ["KIND"]


def limit(sensor: Sensor | None, options: ExportOptions) -> int:
    """The number of pictures. Raises ConfigurationError for a video that is too large."""
    camera = video_camera(sensor, options.width, options.height)
    return check_size(options.seconds, options.pictures_a_second, camera.width, camera.height)


def write(source: ExportSource, file: Path, options: ExportOptions) -> str:
    """Write the file. Raises SceneError, ConfigurationError and OSError."""
    scene, camera = source.need_scene(), video_camera(source.need_sensor(), options.width, options.height)
    path = _path(source, options)
    count = limit(source.sensor, options)
    with Mp4Writer(file, options.pictures_a_second) as video:
        for picture in scene_pictures(scene, path, camera, count, source.white, bool(options.through)):
            video.write(picture)
    return f"{count} pictures of {camera.width} x {camera.height}, {options.seconds:g} s"


def _path(source: ExportSource, options: ExportOptions) -> CameraPath:
    if not options.through:
        recorded = source.need_path()
        return recorded_path(recorded) if options.along == "recorded" else calm_path(recorded)
    if source.unit != "scene":
        raise ConfigurationError("poses to go through are in the unit of the scene: leave metres out")
    poses = np.array(options.through, float)
    if poses.ndim != 2 or poses.shape[1] != 7 or not np.isfinite(poses).all() or not poses[:, 3:].any(axis=1).all():
        raise ConfigurationError("a pose to go through has seven numbers: a centre, and a quaternion that is not zero")
    rotations = np.array([rotation_of(one / np.abs(one).max()) for one in poses[:, 3:]])
    return waypoint_path(Trajectory(np.arange(len(poses), dtype=float), rotations, poses[:, :3]))


KIND = ExportKind(
    name="video",
    title="MP4 along the recorded path, as it is or smoothed, or through chosen poses",
    readers="browsers, players, slides",
    loses="everything but what the camera would have seen",
    suffix=".mp4",
    fill=write,
    limit=limit,
    packages=("av",),
    extra="video",
    media_type="video/mp4",
)
