"""`spiked scale`: metres for a reconstruction."""

from pathlib import Path
from typing import Annotated

import typer

from spiked.errors import ConfigurationError
from spiked.frame_of_reference import FrameOfReference
from spiked.tag_scale import TAG_FAMILIES, scale_by_tags
from spiked.whole_files import whole_folder
from spiked_service.cli import outputs
from spiked_service.cli.console import output
from spiked_service.cli.maps import read_map
from spiked_service.results.map_folder import MapFolder
from spiked_service.results.scene_scale import METRIC, SCALE, ScaleSource, SceneScale, read_scale, write_scale


def scale(
    map_folder: Annotated[
        Path, typer.Argument(metavar="OUT", help="Output folder of `spiked reconstruct` or `merge`.")
    ],
    tag: Annotated[
        float | None, typer.Option(help="Side of the black square of AprilTags in the scene, in metres.")
    ] = None,
    family: Annotated[str, typer.Option(help=f"Family of the tags: {', '.join(TAG_FAMILIES)}.")] = "36h11",
    length: Annotated[
        tuple[float, float] | None,
        typer.Option(metavar="METRES UNITS", help="A known length in metres, and what it is in the scene's unit."),
    ] = None,
    up: Annotated[
        tuple[float, float, float] | None,
        typer.Option(metavar="X Y Z", help="Direction of up in the scene. Default: as stored, else its own -y."),
    ] = None,
) -> None:
    """Give a reconstruction its scale in metres, by AprilTags in the view or by a known length.

    A moving camera alone knows no metres. Tags are found by themselves, in pictures of the scene rendered along the
    path; print one of the family 36h11, and measure its black square. OUT gets scale.json, and the folder metric with
    scene.ply and trajectory.tum in metres, with up along -y.

    Examples:

    - `spiked scale out --tag 0.10`

    - `spiked scale out --length 3.0 1.42`
    """
    if (tag is None) == (length is None):
        raise ConfigurationError("give --tag METRES, or --length METRES UNITS")
    outputs.try_folder("OUT", map_folder, (SCALE,))
    found = read_map(map_folder)
    before = read_scale(map_folder)
    kept = before.up if up is None else up
    if length is not None:
        metres, units = length
        frame = FrameOfReference(metres / units if units > 0 else -1.0, kept)
        sigma, source = None, ScaleSource.LENGTH
    else:
        by_tags = scale_by_tags(found.scene, found.trajectory, found.camera, tag or 0.0, family)
        for one in by_tags.tags:
            output.print(
                f"tag {one.tag} in {one.views} views: {one.side:.5g} units (+- {one.sigma:.2%}), corners within "
                f"{one.error_px:.2f} px",
                markup=False,
            )
        frame = FrameOfReference(by_tags.metres_per_unit, kept)
        sigma, source = by_tags.sigma, ScaleSource.TAG
    made = SceneScale(metres_per_unit=frame.metres_per_unit, sigma=sigma, source=source, up=frame.direction)
    _write(map_folder, found, made)
    sure = "" if made.sigma is None else f" (+- {made.sigma:.2%})"
    output.print(
        f"{map_folder}: a unit is {frame.metres_per_unit:.6g} m{sure}; {map_folder / METRIC} is in metres", markup=False
    )


def _write(map_folder: Path, found: MapFolder, made: SceneScale) -> None:
    """Write scale.json, and the folder metric."""
    frame = made.frame
    assert frame is not None, "a scale was found"
    notes = made.known.in_metres.notes
    with outputs.writing("OUT", map_folder):
        with whole_folder(map_folder / METRIC) as metric:
            frame.scene(found.scene).write_ply(metric / "scene.ply", notes=notes)
            frame.trajectory(found.trajectory).write_tum(metric / "trajectory.tum", notes)
            (map_folder / SCALE).unlink(missing_ok=True)  # a kill between the two leaves no scale, not another one
        write_scale(map_folder, made)
