"""`spiked simulate`: a recording with ground truth, of the built-in room or of a given scene and path."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from spiked.errors import ConfigurationError
from spiked.render.cpu import usable_cores
from spiked.sensor import Mosaic, Response, Sensor
from spiked.simulate import MotionKind, SimulatedCamera
from spiked.simulate.camera import DEFAULT_GAIN, LONG_FRAMES, LONG_STEP_PX, default_step_px
from spiked.simulate.record import camera_of_files
from spiked.simulate.record import simulate as write_simulation
from spiked_service.cli import outputs
from spiked_service.cli.console import messages, output
from spiked_service.cli.recording_flags import DistortionText, with_optics

_FOV_DEG = 60.0
"""Horizontal field of view if none is given, degrees."""
_LINE_S = 10.0
"""Time between two lines of progress where standard error is not a terminal."""


def simulate(
    out: Annotated[Path, typer.Option("--out", "-o", help="New folder for recording and ground truth.")],
    name: Annotated[str, typer.Option(help="Name of the recording.")] = "simulated",
    frames: Annotated[int, typer.Option(help="Number of frames.", min=1)] = 1280,
    scene: Annotated[Path | None, typer.Option(help="A 3DGS PLY instead of the built-in room.")] = None,
    poses: Annotated[Path | None, typer.Option(help="TUM file of the camera path; needs --scene.")] = None,
    motion: Annotated[MotionKind, typer.Option(help="Path through the built-in room.")] = MotionKind.HAND_SHAKE,
    flow: Annotated[
        float, typer.Option(help="Image motion in pixels per frame, in the built-in room.", min=0.0)
    ] = 0.12,
    width: Annotated[int, typer.Option(help="Width in pixels; a multiple of 8.")] = 400,
    height: Annotated[int, typer.Option(help="Height in pixels.")] = 250,
    rate: Annotated[float, typer.Option(help="Frame rate in Hz.")] = 20_000.0,
    mosaic: Annotated[Mosaic | None, typer.Option(help="Colour mosaic of the upright image. Default: grey.")] = None,
    response: Annotated[
        Response, typer.Option(help="How light becomes spikes; bernoulli: a single-photon camera.")
    ] = Response.INTEGRATE_AND_FIRE,
    fov: Annotated[float | None, typer.Option(help="Horizontal field of view in degrees. Default: 60.")] = None,
    intrinsics: Annotated[str | None, typer.Option(help="fx,fy,cx,cy in pixels.", metavar="FX,FY,CX,CY")] = None,
    distortion: DistortionText = None,
    gain: Annotated[
        float | None,
        typer.Option(help="Spikes per frame of white. Default: from the PLY, or 0.35."),
    ] = None,
    views: Annotated[int, typer.Option(help="Number of held-out noise-free views.", min=0)] = 16,
    picture_step: Annotated[
        float | None,
        typer.Option(
            help="Image motion in pixels between exact pictures; frames between are interpolated, and the sidecar says "
            f"with what error. Default: {LONG_STEP_PX} (off by 0.1 to 0.2 % of white RMS) above {LONG_FRAMES} frames; "
            "up to that length, an exact picture at least every 8 frames.",
            min=0.01,
        ),
    ] = None,
    seed: Annotated[int, typer.Option(help="Same seed and options: same bytes.")] = 0,
) -> None:
    """Simulate a camera with shot, thermal, dark and fixed-pattern noise, with ground truth.

    With --distortion the recording is distorted; the held-out views are not. The folder views_lens then has the same
    views through the lens, for `spiked evaluate`.

    Examples:

    - `spiked simulate -o room --frames 1280`

    - `spiked simulate -o again --scene out/scene.ply --poses out/trajectory.tum --fov 60`

    - `spiked simulate -o wide --fov 120 --distortion fisheye:0.02`

    - `spiked simulate -o walk --scene flat.ply --poses walk.tum --fov 60 --frames 200000 --views 40`
    """
    outputs.try_folder("--out", out)
    sensor = Sensor(width, height, rate, mosaic=mosaic, response=response)
    if intrinsics is None and fov is None:
        fov = _FOV_DEG
    sensor = with_optics(sensor, fov, intrinsics, distortion)
    if (scene is None) != (poses is None):
        raise ConfigurationError("give --scene and --poses together")
    step_px = default_step_px(frames) if picture_step is None else picture_step
    threads = usable_cores()
    if scene is not None and poses is not None:
        camera = camera_of_files(sensor, scene, poses, seed=seed, gain=gain, step_px=step_px, threads=threads)
    else:
        gain = DEFAULT_GAIN if gain is None else gain
        camera = SimulatedCamera(sensor, seed, motion, gain=gain, flow_px=flow, step_px=step_px, threads=threads)
    with show_progress(frames) as show:
        path = write_simulation(camera, out, name, frames, views=views, seed=seed, progress=show)
    output.print(f"{path}: {frames} frames, {sensor.width}x{sensor.height}, ground truth in {out / 'groundtruth.tum'}")


@contextmanager
def show_progress(frames: int, every_s: float = _LINE_S) -> Iterator[Callable[[int], None]]:
    """A bar with the time left; off a terminal, a plain line every `every_s` seconds."""
    bar = Progress(
        TextColumn("simulating"),
        BarColumn(bar_width=28),
        TaskProgressColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=messages,
        transient=True,
        disable=not messages.is_terminal,
    )
    task = bar.add_task("simulating", total=frames)
    begin = last = time.monotonic()

    def show(done: int) -> None:
        nonlocal last
        bar.update(task, completed=done)
        now = time.monotonic()
        if not messages.is_terminal and now - last >= every_s:
            last = now
            left = (now - begin) * (frames / done - 1)
            messages.print(f"simulating: {done}/{frames} frames, {left:.0f} s left", markup=False)

    with bar:
        yield show
