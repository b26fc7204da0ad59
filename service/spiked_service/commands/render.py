"""`spiked render`: pictures of a scene along a path."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.progress import track

from spiked.errors import ConfigurationError
from spiked.render import Camera
from spiked.render.cpu import Rasteriser
from spiked.scene import Scene
from spiked.sensor import Intrinsics
from spiked.trajectory import Trajectory
from spiked_service.console import messages, output
from spiked_service.geometry import parse_intrinsics
from spiked_service.images import ImageFormat, encode


def render(
    scene: Annotated[Path, typer.Argument(help="A 3DGS PLY.", readable=False)],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the pictures.")],
    poses: Annotated[Path, typer.Option(help="Where to look from, a TUM file, camera-to-world.")],
    count: Annotated[int, typer.Option(help="Pictures, spread evenly over the path.", min=1)] = 8,
    width: Annotated[int, typer.Option(help="Pixels in a row.")] = 400,
    height: Annotated[int, typer.Option(help="Rows.")] = 250,
    fov: Annotated[float, typer.Option(help="Horizontal field of view, degrees.")] = 60.0,
    intrinsics: Annotated[str | None, typer.Option(help="fx,fy,cx,cy in pixels; wins over --fov.")] = None,
    white: Annotated[float, typer.Option(help="Radiance of white, spikes a frame.")] = 0.35,
    kind: Annotated[ImageFormat, typer.Option("--format", help="PNG, or EXR with radiance.")] = ImageFormat.PNG,
) -> None:
    """Render a scene from poses along a path.

    Example: `spiked render out/scene.ply --poses out/trajectory.tum -o views --count 4`
    """
    k = parse_intrinsics(intrinsics) if intrinsics else Intrinsics.from_fov(width, height, fov)
    rasteriser = Rasteriser(Camera(k, width, height))
    splats, path = Scene.read_ply(scene), Trajectory.read_tum(poses)
    rows = np.unique(np.linspace(0, len(path) - 1, count).round().astype(int))
    try:
        out.mkdir(parents=True, exist_ok=True)
        for row in track(rows, "rendering", console=messages, transient=True):
            image = rasteriser.forward(splats, path.rotations[row][None], path.centres[row][None])
            (out / f"{row:06d}.{kind}").write_bytes(encode(image.values, kind, white))
    except OSError as error:
        raise ConfigurationError(f"cannot write pictures to {out}: {error.strerror}") from error
    output.print(f"{out}: {len(rows)} pictures")
