"""`spiked simulate`: a recording with ground truth, of the built-in room, a given scene and path, or pictures."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from spiked.errors import ConfigurationError
from spiked.render.cpu import usable_cores
from spiked.sensor import Mosaic, Response, Sensor
from spiked.simulate import MotionKind, NoiseOptions, SimulatedCamera
from spiked.simulate.camera import DEFAULT_GAIN, LONG_FRAMES, LONG_STEP_PX, default_step_px
from spiked.simulate.pictures.record import Interpolation
from spiked.simulate.record import camera_of_files
from spiked.simulate.record import simulate as write_simulation
from spiked_service.cli import noise_flags as n
from spiked_service.cli import outputs
from spiked_service.cli.console import messages, output
from spiked_service.cli.flag_groups import with_groups
from spiked_service.cli.picture_simulation import VideoOptions, simulate_video
from spiked_service.cli.recording_flags import DistortionText, with_optics

_FOV_DEG = 60.0
"""Horizontal field of view if none is given, degrees."""
_FRAMES, _VIEWS = 1280, 16
"""Frames and held-out views of a rendered recording if none are given."""
_WIDTH, _HEIGHT = 400, 250
"""Pixels of a rendered recording if none are given."""
_PICTURES = "Spikes from pictures"
_LINE_S = 10.0
"""Time between two lines of progress where standard error is not a terminal."""


@dataclass(frozen=True)
class LightFlags:
    """What a simulated camera sees."""

    scene: Annotated[Path | None, typer.Option(help="A 3DGS PLY instead of the built-in room.")] = None
    poses: Annotated[
        Path | None,
        typer.Option(help="TUM file of the camera path, of --scene or --video; of a video also a transforms.json."),
    ] = None
    video: Annotated[
        Path | None,
        typer.Option(help="A video, or a folder of images, instead of the built-in room.", rich_help_panel=_PICTURES),
    ] = None
    picture_rate: Annotated[
        float | None,
        typer.Option(
            help="Pictures a second, instead of the times that the video, a file times.txt or the names state; of slow "
            "motion, those of the camera.",
            min=1e-3,
            max=1e6,
            rich_help_panel=_PICTURES,
        ),
    ] = None
    gamma: Annotated[
        str,
        typer.Option(
            help="How values of pictures follow from light: srgb, linear, or an exponent such as 2.2.",
            rich_help_panel=_PICTURES,
        ),
    ] = "srgb"
    interpolation: Annotated[
        Interpolation,
        typer.Option(
            help="Light between pictures: linear fades from one to the next; motion moves it along the optical flow.",
            rich_help_panel=_PICTURES,
        ),
    ] = Interpolation.LINEAR
    motion: Annotated[MotionKind, typer.Option(help="Path through the built-in room.")] = MotionKind.HAND_SHAKE
    flow: Annotated[float, typer.Option(help="Image motion in pixels per frame, in the built-in room.", min=0.0)] = 0.12


@dataclass(frozen=True)
class CameraFlags:
    """Geometry and optics of a simulated camera."""

    width: Annotated[
        int | None, typer.Option(help="Width in pixels; a multiple of 8. Default: 400, or that of the pictures.")
    ] = None
    height: Annotated[int | None, typer.Option(help="Height in pixels. Default: 250, or that of the pictures.")] = None
    rate: Annotated[float, typer.Option(help="Frame rate in Hz.")] = 20_000.0
    mosaic: Annotated[Mosaic | None, typer.Option(help="Colour mosaic of the upright image. Default: grey.")] = None
    response: Annotated[Response, typer.Option(help="How light becomes spikes; bernoulli: a single-photon camera.")] = (
        Response.INTEGRATE_AND_FIRE
    )
    fov: Annotated[float | None, typer.Option(help="Horizontal field of view in degrees. Default: 60.")] = None
    intrinsics: Annotated[str | None, typer.Option(help="fx,fy,cx,cy in pixels.", metavar="FX,FY,CX,CY")] = None
    distortion: DistortionText = None

    def sensor(self) -> Sensor:
        """Of a rendered scene. Raises ConfigurationError."""
        size = self.width or _WIDTH, self.height or _HEIGHT
        fov = _FOV_DEG if self.intrinsics is None and self.fov is None else self.fov
        sensor = Sensor(*size, self.rate, mosaic=self.mosaic, response=self.response)
        return with_optics(sensor, fov, self.intrinsics, self.distortion)


@dataclass(frozen=True)
class TakeFlags:
    """Light level, held-out views and random numbers of a simulation."""

    gain: Annotated[
        float | None,
        typer.Option(help="Spikes per frame of white. Default: from the PLY, or 0.35."),
    ] = None
    views: Annotated[
        int | None,
        typer.Option(help="Number of held-out noise-free views. Default: 16; of pictures: 0.", min=0),
    ] = None
    picture_step: Annotated[
        float | None,
        typer.Option(
            help="Image motion in pixels between exact pictures; frames between are interpolated, and the sidecar says "
            f"with what error. Default: {LONG_STEP_PX} (off by 0.1 to 0.2 % of white RMS) above {LONG_FRAMES} frames; "
            "up to that length, an exact picture at least every 8 frames. With --interpolation motion: between "
            "pictures that are made.",
            min=0.01,
        ),
    ] = None
    seed: Annotated[int, typer.Option(help="Same seed and options: same bytes.")] = 0


@with_groups
def simulate(
    context: typer.Context,
    out: Annotated[Path, typer.Option("--out", "-o", help="New folder for recording and ground truth.")],
    name: Annotated[str, typer.Option(help="Name of the recording.")] = "simulated",
    frames: Annotated[
        int | None, typer.Option(help="Number of frames. Default: 1280; of pictures: as long as they last.", min=1)
    ] = None,
    *,
    light: LightFlags,
    camera: CameraFlags,
    take: TakeFlags,
    noise: n.NoiseFlags,
) -> None:
    """Simulate a camera with shot, thermal, dark and fixed-pattern noise, with ground truth.

    With --distortion the recording is distorted; the held-out views are not. The folder views_lens then has the same
    views through the lens, for `spiked evaluate`.

    With --video the light comes from pictures, scaled and cut to --width and --height, and runs evenly from one to the
    next. The command says how far apart they are, and warns where that shows edges twice.

    Examples:

    - `spiked simulate -o room --frames 1280`

    - `spiked simulate -o again --scene out/scene.ply --poses out/trajectory.tum --fov 60`

    - `spiked simulate -o lamp --flicker 0.3 --dark 0.01 --hot-share 0.001 --temperature-k 340`

    - `spiked simulate -o street --video street.mp4 --picture-rate 960 --width 400 --height 250 --fov 60`

    - `spiked simulate -o wide --fov 120 --distortion fisheye:0.02`

    - `spiked simulate -o walk --scene flat.ply --poses walk.tum --fov 60 --frames 200000 --views 40`
    """
    outputs.try_folder("--out", out)
    options = noise.options().checked(camera.response)
    if light.video is not None:
        _refuse_with_video(context)
        given: dict[str, Any] = {one.name: context.params.get(one.name) for one in fields(VideoOptions)}
        given |= {"noise": options, "threads": usable_cores(), "views": take.views or 0}
        simulate_video(VideoOptions(**given), show_progress)
        return
    frames = _FRAMES if frames is None else frames
    views = _VIEWS if take.views is None else take.views
    made = _rendered(light, camera.sensor(), take, options, default_step_px(frames))
    with show_progress("simulating", frames) as show:
        path = write_simulation(made, out, name, frames, views=views, seed=take.seed, progress=show)
    size = f"{made.sensor.width}x{made.sensor.height}"
    output.print(f"{path}: {frames} frames, {size}, ground truth in {out / 'groundtruth.tum'}")


def _rendered(
    light: LightFlags, sensor: Sensor, take: TakeFlags, noise: NoiseOptions, step_px: float | None
) -> SimulatedCamera:
    """The camera in a scene; `step_px`: between exact pictures if the flags do not say. Raises ConfigurationError."""
    if (light.scene is None) != (light.poses is None):
        raise ConfigurationError("give --scene and --poses together")
    common: dict[str, Any] = {
        "seed": take.seed,
        "noise": noise.noise(),
        "lighting": noise.lighting(),
        "step_px": step_px if take.picture_step is None else take.picture_step,
        "threads": usable_cores(),
    }
    if light.scene is not None and light.poses is not None:
        return camera_of_files(sensor, light.scene, light.poses, gain=take.gain, **common)
    gain = DEFAULT_GAIN if take.gain is None else take.gain
    return SimulatedCamera(sensor, motion=light.motion, gain=gain, flow_px=light.flow, **common)


def _refuse_with_video(context: typer.Context) -> None:
    """Raises ConfigurationError for options of a rendered scene."""
    sources = {name: context.get_parameter_source(name) for name in ("scene", "motion", "flow")}
    stated = [f"--{name}" for name, source in sources.items() if source is not None and source.name == "COMMANDLINE"]
    if stated:
        raise ConfigurationError(f"--video is the scene itself: leave out {', '.join(stated)}")


@contextmanager
def show_progress(
    work: str, total: int, units: str = "frames", every_s: float = _LINE_S
) -> Iterator[Callable[[int], None]]:
    """A bar with the time left; off a terminal, a plain line every `every_s` seconds."""
    bar = Progress(
        TextColumn(work),
        BarColumn(bar_width=28),
        TaskProgressColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=messages,
        transient=True,
        disable=not messages.is_terminal,
    )
    task = bar.add_task(work, total=total)
    begin = last = time.monotonic()

    def show(done: int) -> None:
        nonlocal last
        bar.update(task, completed=done)
        now = time.monotonic()
        if not messages.is_terminal and now - last >= every_s:
            last = now
            left = (now - begin) * (total / done - 1)
            messages.print(f"{work}: {done}/{total} {units}, {left:.0f} s left", markup=False)

    with bar:
        yield show
