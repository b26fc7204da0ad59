"""`spiked video`: an MP4 of a scene along a path, or of a recording in slow motion."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray
from rich.progress import track

from spiked.errors import ConfigurationError
from spiked.export import ExportSource
from spiked.scene import Scene
from spiked.trajectory import Trajectory
from spiked.video import (
    CameraPath,
    Mp4Writer,
    SlowMotion,
    calm_path,
    recorded_path,
    scene_pictures,
    slow_motion,
    video_camera,
    waypoint_path,
)
from spiked.video.mp4 import QUALITY
from spiked.video.rate_pictures import WINDOW
from spiked_service.cli import outputs
from spiked_service.cli import recording_flags as g
from spiked_service.cli.console import messages, output, report_warning
from spiked_service.cli.flag_groups import with_groups
from spiked_service.cli.ranges import Range, number_range
from spiked_service.results.report.folder import FolderReport

video = typer.Typer(help="MP4 of a scene along a path, or of a recording in slow motion.", no_args_is_help=True)

DEFAULT_S = 10.0
"""Length of a video that is not chosen, seconds."""
_SIDE = {"min": 16, "max": 8192}

Out = Annotated[Path | None, typer.Option("--out", "-o", help="File to write, .mp4.")]
PicturesASecond = Annotated[float, typer.Option("--fps", help="Pictures a second of the video.", min=1, max=240)]
Quality = Annotated[
    int, typer.Option(help="Constant rate factor of H.264: 18 looks like the source, 28 is small.", min=0, max=51)
]


@video.command("scene")
def video_of_scene(
    result: Annotated[
        Path,
        typer.Argument(
            metavar="OUT", help="Output folder of `spiked reconstruct`, or a PLY of splats.", readable=False
        ),
    ],
    out: Out = None,
    path: Annotated[
        str,
        typer.Option(
            metavar="smooth|recorded|FILE.tum",
            help="The recorded path without tremor, as it is, or smoothly through the poses of a file.",
        ),
    ] = "smooth",
    seconds: Annotated[float, typer.Option(help="Length of the video.", min=0.1, max=3600)] = DEFAULT_S,
    fps: PicturesASecond = 30.0,
    width: Annotated[int | None, typer.Option(help="Pixels. Default: of the recording, or 1280.", **_SIDE)] = None,
    height: Annotated[int | None, typer.Option(help="Pixels. Default: by the width.", **_SIDE)] = None,
    fov: Annotated[
        float | None,
        typer.Option(help="Horizontal field of view, degrees. Default: of the recording, or 60.", min=1, max=170),
    ] = None,
    quality: Quality = QUALITY,
) -> None:
    """Fly through a scene.

    The camera takes the same time for the whole path, however long the recording was. The lens of a video has no
    distortion.

    Examples:

    - `spiked video scene out`

    - `spiked video scene out --path recorded --seconds 30 --width 1920 -o walk.mp4`

    - `spiked video scene out/scene.ply --path bookmarks.tum --fov 75`
    """
    place = out or (result / "video.mp4" if result.is_dir() else result.with_suffix(".mp4"))
    outputs.try_file("--out", place)
    source = _source(result)
    scene = source.need_scene()
    camera = video_camera(source.sensor, width, height, fov)
    count = max(1, round(seconds * fps))
    pictures = scene_pictures(scene, _path(path, source), camera, count, source.white)
    _write(place, fps, quality, pictures, count)
    output.print(f"{place}: {count} pictures of {camera.width} x {camera.height}, {count / fps:.3g} s", markup=False)


def _source(result: Path) -> ExportSource:
    if result.is_dir():
        return FolderReport(result).export_source()
    return ExportSource.of_splats(Scene.read_ply(result), result.name)


def _path(named: str, source: ExportSource) -> CameraPath:
    match named:
        case "smooth" | "recorded" if not len(source.path):
            raise ConfigurationError(f"{source.name} has no path: name one with --path FILE.tum")
        case "smooth":
            return calm_path(source.path)
        case "recorded":
            return recorded_path(source.path)
    return waypoint_path(Trajectory.read_tum(Path(named)))


@video.command("recording")
@with_groups
def video_of_recording(
    file: Annotated[Path, typer.Argument(help="A recording.", readable=False)],
    out: Out = None,
    slower: Annotated[
        float | None,
        typer.Option(help=f"Seconds of video for a second of recording. Default: {DEFAULT_S:g} s of video.", min=0.001),
    ] = None,
    window: Annotated[int, typer.Option(help="Frames of a picture.", min=1, max=4096)] = WINDOW,
    compensate: Annotated[
        bool,
        typer.Option(
            "--compensate", help="Add the pictures before and after to each, moved along the motion: less noise."
        ),
    ] = False,
    seconds: Annotated[
        Range | None,
        typer.Option(help="Part of the recording, seconds of it.", parser=number_range(float), metavar="A:B"),
    ] = None,
    fps: PicturesASecond = 30.0,
    quality: Quality = QUALITY,
    *,
    geometry: g.GeometryFlags,
) -> None:
    """Show a recording in slow motion.

    A picture is the charge between the spikes at both edges of its window. Pictures whose frames were lost are black,
    and counted.

    Examples:

    - `spiked video recording rec.dat`

    - `spiked video recording rec.dat --slower 2000 --seconds 0.1:0.15 --window 8 --compensate -o drop.mp4`
    """
    place = out or file.with_suffix(".mp4")
    outputs.try_file("--out", place)
    recording = g.open_described(file, geometry.stated(), None).recording
    for warning in recording.warnings:
        report_warning(warning)
    part = seconds or Range(None, None)
    how = SlowMotion(1.0, fps, window, compensate, part.begin or 0.0, part.end)
    how = replace(how, slower=slower or DEFAULT_S / how.duration_s(recording))
    times = how.times_s(recording)
    lost = 0

    def shown() -> Iterator[NDArray[np.uint8]]:
        nonlocal lost
        black = np.zeros((recording.sensor.height, recording.sensor.width), np.uint8)
        for picture in slow_motion(recording, how):
            lost += picture is None
            yield black if picture is None else picture

    _write(place, fps, quality, shown(), len(times))
    without = f", {lost} of them black: their frames were lost" if lost else ""
    output.print(
        f"{place}: {len(times)} pictures{without}, {len(times) / fps:.3g} s, {how.slower:.3g} times slower",
        markup=False,
    )


def _write(place: Path, fps: float, quality: int, pictures: Iterator[NDArray[np.uint8]], count: int) -> None:
    with outputs.writing("--out", place), Mp4Writer(place, fps, quality=quality) as file:
        for picture in track(pictures, "rendering", total=count, console=messages, transient=True):
            file.write(picture)
