"""`spiked simulate`: a recording with its truth, from the built-in room or from a scene and a path."""

from pathlib import Path
from typing import Annotated

import typer
from rich.progress import Progress

from spiked.errors import ConfigurationError
from spiked.sensor import Mosaic, Sensor
from spiked.simulate import MotionKind, SimulatedCamera
from spiked.simulate.record import camera_of_files
from spiked.simulate.record import simulate as write_simulation
from spiked_service.console import messages, output
from spiked_service.geometry import with_optics

_FOV_DEG = 60.0


def simulate(
    out: Annotated[Path, typer.Option("--out", "-o", help="A new folder for the recording and its truth.")],
    name: Annotated[str, typer.Option(help="Name of the recording in it.")] = "simulated",
    frames: Annotated[int, typer.Option(help="Length.", min=1)] = 1280,
    scene: Annotated[Path | None, typer.Option(help="A 3DGS PLY instead of the built-in room.")] = None,
    poses: Annotated[Path | None, typer.Option(help="The camera's path as a TUM file; needs --scene.")] = None,
    motion: Annotated[MotionKind, typer.Option(help="The path through the built-in room.")] = MotionKind.HAND_SHAKE,
    flow: Annotated[float, typer.Option(help="Image motion in pixels a frame, built-in room.", min=0.0)] = 0.12,
    width: Annotated[int, typer.Option(help="Pixels in a row.")] = 400,
    height: Annotated[int, typer.Option(help="Rows.")] = 250,
    rate: Annotated[float, typer.Option(help="Frames a second.")] = 20_000.0,
    mosaic: Annotated[Mosaic | None, typer.Option(help="Colour mosaic of the upright image; grey without.")] = None,
    fov: Annotated[float | None, typer.Option(help="Horizontal field of view in degrees; 60 if not given.")] = None,
    intrinsics: Annotated[str | None, typer.Option(help="fx,fy,cx,cy in pixels.", metavar="FX,FY,CX,CY")] = None,
    gain: Annotated[float, typer.Option(help="Spikes a frame of white.")] = 0.35,
    views: Annotated[int, typer.Option(help="Held-out noise-free pictures.", min=0)] = 16,
    seed: Annotated[int, typer.Option(help="The same seed gives the same bytes.")] = 0,
) -> None:
    """Record a simulated camera with shot, thermal, dark and fixed-pattern noise, and the truth beside it.

    Examples:

    - `spiked simulate -o room --frames 1280`

    - `spiked simulate -o again --scene out/scene.ply --poses out/trajectory.tum --fov 60`
    """
    sensor = with_optics(Sensor(width, height, rate, mosaic=mosaic), fov, intrinsics)
    if sensor.intrinsics is None:
        sensor = with_optics(sensor, _FOV_DEG, None)
    if (scene is None) != (poses is None):
        raise ConfigurationError("a scene of your own needs --scene and --poses together")
    if scene is not None and poses is not None:
        camera = camera_of_files(sensor, scene, poses, seed=seed, gain=gain)
    else:
        camera = SimulatedCamera(sensor, seed, motion, gain=gain, flow_px=flow)
    with Progress(console=messages, transient=True) as bar:
        task = bar.add_task("simulating", total=frames)
        path = write_simulation(
            camera, out, name, frames, views=views, seed=seed, progress=lambda done: bar.update(task, completed=done)
        )
    output.print(f"{path}: {frames} frames, {sensor.width}x{sensor.height}, truth in {out / 'groundtruth.tum'}")
