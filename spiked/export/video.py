"""An MP4 along the recorded path, without its tremor."""

from pathlib import Path

from spiked.export.kind import ExportKind
from spiked.export.source import ExportOptions, ExportSource
from spiked.video import Mp4Writer, calm_path, scene_pictures, video_camera

__all__ = ["KIND"]

PICTURES_A_SECOND = 30
"""Of the video."""


def write(source: ExportSource, file: Path, options: ExportOptions) -> str:
    """Write the file. Raises SceneError, ConfigurationError and OSError."""
    scene, path, camera = source.need_scene(), source.need_path(), video_camera(source.need_sensor())
    count = max(1, round(options.seconds * PICTURES_A_SECOND))
    with Mp4Writer(file, PICTURES_A_SECOND) as video:
        for picture in scene_pictures(scene, calm_path(path), camera, count, source.white):
            video.write(picture)
    return f"{count} pictures of {camera.width} x {camera.height}, {options.seconds:g} s"


KIND = ExportKind(
    name="video",
    title="MP4 along the recorded path, smoothed",
    readers="browsers, players, slides",
    loses="everything but what the camera would have seen",
    suffix=".mp4",
    fill=write,
    packages=("av",),
    extra="video",
    media_type="video/mp4",
)
