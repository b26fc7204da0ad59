"""`spiked render`: pictures of a scene along a path."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import track

from spiked.distortion import Distortion
from spiked.recon.statistics import evenly
from spiked.render import Camera
from spiked.render.cpu import Rasteriser
from spiked.scene import Scene
from spiked.sensor import Intrinsics
from spiked.trajectory import Trajectory
from spiked.whole_files import whole_folder
from spiked_service.cli import outputs
from spiked_service.cli.console import messages, output
from spiked_service.cli.recording_flags import DistortionText, parse_intrinsics
from spiked_service.results.image_encoding import ImageFormat, encode


def render(
    scene: Annotated[Path, typer.Argument(help="A 3DGS PLY.", readable=False)],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the pictures.")],
    poses: Annotated[Path, typer.Option(help="TUM file of camera-to-world poses.")],
    count: Annotated[int, typer.Option(help="Number of pictures, evenly spaced along the path.", min=1)] = 8,
    width: Annotated[int, typer.Option(help="Width in pixels.")] = 400,
    height: Annotated[int, typer.Option(help="Height in pixels.")] = 250,
    fov: Annotated[float, typer.Option(help="Horizontal field of view in degrees.")] = 60.0,
    intrinsics: Annotated[str | None, typer.Option(help="fx,fy,cx,cy in pixels; overrides --fov.")] = None,
    distortion: DistortionText = None,
    white: Annotated[
        float | None,
        typer.Option(help="Radiance shown as white. Default: from the PLY, or 1.", min=1e-9),
    ] = None,
    kind: Annotated[ImageFormat, typer.Option("--format", help="exr stores unscaled values.")] = ImageFormat.PNG,
) -> None:
    """Render a scene from poses along a path.

    The colours of our own scenes are radiance, in spikes a frame, and their PLY says which radiance is white. Those of
    other programs' scenes are values for a display, of which 1 is white.

    Example: `spiked render out/scene.ply --poses out/trajectory.tum -o views --count 4`
    """
    outputs.try_folder("--out", out)
    lens = None if distortion is None else Distortion.parse(distortion)
    k = Intrinsics.from_fov(width, height, fov, lens)
    if intrinsics:
        k = replace(parse_intrinsics(intrinsics), distortion=lens)
    rasteriser = Rasteriser(Camera(k, width, height))
    splats, path = Scene.read_ply(scene), Trajectory.read_tum(poses)
    shown_white = splats.colour_of_white if white is None else white
    rows = evenly(len(path), count)
    with outputs.writing("--out", out), whole_folder(out, stale=(f"{6 * '[0-9]'}.*",)) as making:
        for row in track(rows, "rendering", console=messages, transient=True):
            shown = splats.seen_from(path.centres[row])
            image = rasteriser.forward(shown, path.rotations[row][None], path.centres[row][None])
            (making / f"{row:06d}.{kind}").write_bytes(encode(image.values, kind, shown_white))
    output.print(f"{out}: {len(rows)} pictures")
