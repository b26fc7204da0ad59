"""`spiked merge`: two reconstructions of one place as one map."""

from pathlib import Path
from typing import Annotated

import typer
from rich.progress import Progress

from spiked.errors import ConfigurationError
from spiked.recon import Merged
from spiked.recon import merge as merge_maps
from spiked.recon.environment import versions
from spiked_service.cli import outputs
from spiked_service.cli.console import messages, output
from spiked_service.cli.maps import read_map
from spiked_service.results.map_folder import MAP_FILES, MapFolder, joint_paths, write_map


def merge(
    first: Annotated[Path, typer.Argument(metavar="A", help="Output folder of `spiked reconstruct` or `merge`.")],
    second: Annotated[Path, typer.Argument(metavar="B", help="Another one, of the same place.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the joint map; created if missing.")],
    seed: Annotated[int, typer.Option(help="Seed of all random choices.")] = 0,
    threads: Annotated[int | None, typer.Option(help="Threads. Default: all cores.", min=1)] = None,
) -> None:
    """Make one map of two reconstructions of the same place, in A's frame of reference and unit of length.

    Views of B are recognised in A, and have to agree on how the two lie to each other. OUT has the joint scene.ply, the
    path of each recording in paths/, and report.json, which says what was merged, by which similarity, and how sure
    that is. It is a map like A and B for `localise`, `merge` and `reconstruct --map`. trajectory.tum is A's.

    If the two do not show the same place, the exit code is 2, and nothing is written.

    Example: `spiked merge monday tuesday -o flat`
    """
    outputs.try_folder("--out", out, MAP_FILES)
    if out.resolve() in (first.resolve(), second.resolve()):
        raise ConfigurationError(f"--out {out} is one of the maps that are merged; name another folder")
    maps = read_map(first), read_map(second)
    with Progress(console=messages, transient=True, disable=not messages.is_terminal) as bar:
        task = bar.add_task("merging", total=1.0)
        merged = merge_maps(
            maps[0].known,
            maps[1].known,
            seed=seed,
            threads=threads,
            progress=lambda share: bar.update(task, completed=share),
        )
    paths = joint_paths(maps[0].paths, maps[1].paths, merged.joint.second.trajectory)
    with outputs.writing("--out", out):
        write_map(out, merged.scene, maps[0].trajectory, paths, _report(merged, (first, second), maps))
    found = merged.joint.registration
    output.print(
        f"{out}: {len(merged.scene)} splats, paths {', '.join(paths)}; {len(found.sightings)} views of "
        f"{second} agree, a length in it is {found.similarity.scale:.5g} (+- {found.scale_sigma:.2%}) in {first}",
        markup=False,
    )


def _report(merged: Merged, folders: tuple[Path, Path], maps: tuple[MapFolder, MapFolder]) -> dict[str, object]:
    intrinsics = maps[0].intrinsics
    distortion = intrinsics.distortion
    lens = {} if distortion is None else {"distortion": {"model": str(distortion.model), **distortion.named()}}
    return {
        "versions": versions(),
        "sensor": {"width": maps[0].width, "height": maps[0].height},
        "focal_px": [intrinsics.fx, intrinsics.fy],
        "principal_point_px": [intrinsics.cx, intrinsics.cy],
        **lens,
        "outcome": next((one.outcome for one in maps if one.outcome != "complete"), "complete"),
        "splats": len(merged.scene),
        "merged": {
            "maps": [
                {"folder": str(folder), "versions": one.versions, "splats": len(one.scene), "paths": list(one.paths)}
                for folder, one in zip(folders, maps, strict=True)
            ],
            **merged.report(),
        },
    }
