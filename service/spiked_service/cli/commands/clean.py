"""`spiked clean`: a scene without floaters."""

import json
import shutil
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import Progress

from spiked.cleaning import Box, FloaterRemoval
from spiked.cleaning import clean as clean_scene
from spiked.errors import ConfigurationError
from spiked_service.cli import outputs
from spiked_service.cli.console import messages, output
from spiked_service.cli.maps import read_map
from spiked_service.results.map_folder import MAP_FILES, PATHS, replacing
from spiked_service.results.scene_scale import SCALE


def clean(
    map_folder: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="Output folder of `spiked reconstruct` or `merge`.")
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the cleaned scene; created if missing.")],
    box: Annotated[
        tuple[float, float, float, float, float, float] | None,
        typer.Option(metavar="X0 Y0 Z0 X1 Y1 Z1", help="Remove splats outside of this box, in the scene's axes."),
    ] = None,
    floaters: Annotated[bool, typer.Option(help="Remove splats that few views see or that hang alone.")] = True,
    split: Annotated[
        bool,
        typer.Option(help="Replace splats larger than a quarter of the scene by smaller ones that show the same."),
    ] = True,
) -> None:
    """Remove floaters from a scene, and what is outside of a box.

    A floater is a splat that fewer than two views along the path see, or one that hangs in the air, far from all
    others. Splats larger than a quarter of the scene become several. OUT is an output folder like the other one, which
    stays as it is.

    Examples:

    - `spiked clean out -o cleaned`

    - `spiked clean out -o desk --box -1 -1 0 1 0.5 3`
    """
    outputs.try_folder("--out", out, MAP_FILES)
    if out.resolve() == map_folder.resolve():
        raise ConfigurationError(f"--out {out} is the scene that is cleaned; name another folder")
    found = read_map(map_folder)
    with Progress(console=messages, transient=True, disable=not messages.is_terminal) as bar:
        task = bar.add_task("cleaning", total=1.0)
        cleaned = clean_scene(
            found.scene,
            found.trajectory,
            found.camera,
            None if box is None else Box(box[:3], box[3:]),
            FloaterRemoval(split=split) if floaters else None,
            lambda share: bar.update(task, completed=share),
        )
    counts = {"outside": cleaned.outside, "floaters": cleaned.floaters}
    counts |= {"split": cleaned.split, "shrunk": cleaned.shrunk, "large": cleaned.large}
    report = json.loads((map_folder / "report.json").read_bytes()) | {"splats": len(cleaned.scene), "cleaned": counts}
    with outputs.writing("--out", out), replacing(out) as making:
        shutil.copyfile(map_folder / "trajectory.tum", making / "trajectory.tum")
        if (map_folder / SCALE).is_file():
            shutil.copyfile(map_folder / SCALE, making / SCALE)
        if (map_folder / PATHS).is_dir():
            shutil.copytree(map_folder / PATHS, making / PATHS)
        cleaned.scene.write_ply(making / "scene.ply")
        (making / "report.json").write_text(json.dumps(report, indent=1), encoding="utf-8")
    output.print(
        f"{out}: {len(cleaned.scene)} of {len(found.scene)} splats; removed {cleaned.outside} outside and "
        f"{cleaned.floaters} floaters, split {cleaned.split} large ones, made {cleaned.shrunk} smaller, "
        f"left {cleaned.large}",
        markup=False,
    )
