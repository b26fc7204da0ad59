"""`spiked scale`: metres for a reconstruction, and which way is up in it."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from spiked.baseline_scale import scale_by_baseline
from spiked.board import DICTIONARIES, Board
from spiked.board_scale import scale_by_board
from spiked.errors import ConfigurationError
from spiked.frame_of_reference import FrameOfReference
from spiked.tag_scale import TAG_FAMILIES, scale_by_tags
from spiked.trajectory import BRIDGED_S
from spiked.upright import find_floor, up_by_gravity, up_by_points
from spiked.whole_files import whole_folder
from spiked_service.cli import outputs
from spiked_service.cli.console import output
from spiked_service.cli.maps import read_map
from spiked_service.results.map_folder import MapFolder
from spiked_service.results.scene_scale import METRIC, SCALE, ScaleSource, SceneScale, read_scale, write_scale

_DIRECTION = tuple[float, float, float]


_Tag = Annotated[float | None, typer.Option(help="Side of the black square of AprilTags in the scene, in metres.")]
_Family = Annotated[str, typer.Option(help=f"Family of the tags: {', '.join(TAG_FAMILIES)}.")]
_Board = Annotated[
    str | None, typer.Option(metavar="COLUMNSxROWS", help="Squares of a ChArUco board in the scene, with --square.")
]
_Square = Annotated[float | None, typer.Option(help="Side of a square of the board, in metres.")]
_Dictionary = Annotated[str, typer.Option(help=f"Markers of the board: {', '.join(sorted(DICTIONARIES))}.")]
_Length = Annotated[
    tuple[float, float] | None,
    typer.Option(metavar="METRES UNITS", help="A known length in metres, and what it is in the scene's unit."),
]
_Baseline = Annotated[
    float | None, typer.Option(help="Distance of the two cameras of a rig whose recordings were merged, in metres.")
]
_Offset = Annotated[float, typer.Option(help="Seconds by which the second of them began later: see `spiked offset`.")]
_Up = Annotated[
    _DIRECTION | None,
    typer.Option(metavar="X Y Z", help="Direction of up in the scene. Default: as stored, else its own -y."),
]
_Gravity = Annotated[
    _DIRECTION | None,
    typer.Option(metavar="X Y Z", help="Gravity in the axes of the camera (y down, z forward) at --at."),
]
_At = Annotated[
    float | None, typer.Option(help="Time of --gravity, seconds since frame 0. Default: of the first pose.")
]
_Floor = Annotated[bool, typer.Option("--floor", help="Up by the floor, which is found.")]
_FloorPoints = Annotated[
    str | None, typer.Option(metavar="'X,Y,Z X,Y,Z X,Y,Z'", help="Up by three points of the floor in the scene.")
]


def scale(
    map_folder: Annotated[
        Path, typer.Argument(metavar="OUT", help="Output folder of `spiked reconstruct` or `merge`.")
    ],
    tag: _Tag = None,
    family: _Family = "36h11",
    board: _Board = None,
    square: _Square = None,
    dictionary: _Dictionary = "4x4_100",
    length: _Length = None,
    baseline: _Baseline = None,
    offset: _Offset = 0.0,
    up: _Up = None,
    gravity: _Gravity = None,
    at: _At = None,
    floor: _Floor = False,
    floor_points: _FloorPoints = None,
) -> None:
    """Give a reconstruction its scale in metres and its direction of up.

    A moving camera alone knows neither. Tags and boards are found by themselves, in pictures of the scene rendered
    along the path; print a tag of the family 36h11, and measure its black square. OUT gets scale.json, and with a
    scale the folder metric with scene.ply and trajectory.tum in metres, with up along -y.

    Examples:

    - `spiked scale out --tag 0.10 --floor`

    - `spiked scale out --board 9x6 --square 0.03`

    - `spiked scale out --length 3.0 1.42`

    - `spiked scale merged --baseline 0.12`
    """
    ways = {"tag": tag, "board": board, "length": length, "baseline": baseline}
    uprights = {"up": up, "gravity": gravity, "floor": floor or None, "floor_points": floor_points}
    _check(ways, uprights)
    outputs.try_folder("OUT", map_folder, (SCALE,))
    found, made = read_map(map_folder), read_scale(map_folder)
    if tag is not None:
        made = _by_tags(found, tag, family, made)
    elif board is not None:
        made = _by_board(found, Board.parse(board, dictionary), square, made)
    elif length is not None:
        made = _known(made, length[0] / length[1] if length[1] > 0 else -1.0, None, ScaleSource.LENGTH)
    elif baseline is not None:
        made = _by_baseline(found, baseline, offset, made)
    upright = _upright(found, up, gravity, at, floor, floor_points)
    if upright is not None:
        made = made.model_copy(update={"up": FrameOfReference(up=upright).direction})
    _write(map_folder, found, made)
    output.print(_said(map_folder, made), markup=False)


def _check(ways: Mapping[str, object], uprights: Mapping[str, object]) -> None:
    """Raises ConfigurationError unless one way to a scale, one to up, or both are given."""
    given = [sum(value is not None for value in one.values()) for one in (ways, uprights)]
    if max(given) > 1 or not any(given):
        raise ConfigurationError(
            "give one of --tag, --board, --length and --baseline, or one of --up, --gravity, --floor and "
            "--floor-points, or one of each"
        )


def _known(before: SceneScale, metres: float, sigma: float | None, source: ScaleSource) -> SceneScale:
    """Raises ConfigurationError for what is no scale."""
    FrameOfReference(metres)
    return before.model_copy(update={"metres_per_unit": metres, "sigma": sigma, "source": source})


def _by_tags(found: MapFolder, side_m: float, family: str, before: SceneScale) -> SceneScale:
    by_tags = scale_by_tags(found.scene, found.trajectory, found.camera, side_m, family)
    for one in by_tags.tags:
        output.print(
            f"tag {one.tag} in {one.views} views: {one.side:.5g} units (+- {one.sigma:.2%}), corners within "
            f"{one.error_px:.2f} px",
            markup=False,
        )
    return _known(before, by_tags.metres_per_unit, by_tags.sigma, ScaleSource.TAG)


def _by_board(found: MapFolder, board: Board, square_m: float | None, before: SceneScale) -> SceneScale:
    if square_m is None:
        raise ConfigurationError("--board needs --square, the side of its squares in metres")
    by_board = scale_by_board(found.scene, found.trajectory, found.camera, board, square_m)
    output.print(
        f"board in {by_board.views} views, {by_board.corners} corners: squares of {by_board.square:.5g} units "
        f"(+- {by_board.sigma:.2%}), corners within {by_board.error_px:.2f} px",
        markup=False,
    )
    return _known(before, by_board.metres_per_unit, by_board.sigma, ScaleSource.BOARD)


def _by_baseline(found: MapFolder, baseline_m: float, offset_s: float, before: SceneScale) -> SceneScale:
    if len(found.paths) != 2:
        raise ConfigurationError(
            f"--baseline needs a map with the paths of two cameras, and this one has {len(found.paths)}; "
            "merge their maps with `spiked merge`"
        )
    first, second = found.paths.values()
    by_baseline = scale_by_baseline(first, second, baseline_m, offset_s)
    names = " and ".join(found.paths)
    output.print(f"{names}: {by_baseline.poses} moments in common", markup=False)
    return _known(before, by_baseline.metres_per_unit, by_baseline.sigma, ScaleSource.BASELINE)


def _upright(
    found: MapFolder,
    up: _DIRECTION | None,
    gravity: _DIRECTION | None,
    at_s: float | None,
    floor: bool,
    floor_points: str | None,
) -> _DIRECTION | None:
    """Up by what is given; None if nothing is. Raises ConfigurationError and SceneError."""
    path = found.trajectory
    if gravity is not None:
        row = 0 if at_s is None else int(np.abs(path.times_s - at_s).argmin())
        if at_s is not None and abs(path.times_s[row] - at_s) > BRIDGED_S:
            raise ConfigurationError(
                f"--at {at_s:g}: the nearest pose is at {path.times_s[row]:g} s, more than {1000 * BRIDGED_S:g} ms away"
            )
        x, y, z = up_by_gravity(gravity, path.rotations[row]).tolist()
    elif floor:
        by_floor = find_floor(found.scene, path)
        output.print(f"a floor with {by_floor.share:.0%} of the splats", markup=False)
        x, y, z = by_floor.up.tolist()
    elif floor_points is not None:
        x, y, z = up_by_points(_points(floor_points), path.centres).tolist()
    else:
        return up
    return x, y, z


def _points(text: str) -> np.ndarray:
    try:
        return np.array([[float(part) for part in point.split(",")] for point in text.split()])
    except ValueError as error:
        raise ConfigurationError(f"--floor-points {text!r}: write three points, as '0,1,2 1,1,2 0,1,3'") from error


def _write(map_folder: Path, found: MapFolder, made: SceneScale) -> None:
    """Write scale.json, and with a scale the folder metric."""
    with outputs.writing("OUT", map_folder):
        if made.frame is not None:
            notes = made.known.in_metres.notes
            with whole_folder(map_folder / METRIC) as metric:
                made.frame.scene(found.scene).write_ply(metric / "scene.ply", notes=notes)
                made.frame.trajectory(found.trajectory).write_tum(metric / "trajectory.tum", notes)
                (map_folder / SCALE).unlink(missing_ok=True)  # a kill between the two leaves no scale, not another one
        write_scale(map_folder, made)


def _said(map_folder: Path, made: SceneScale) -> str:
    up = "" if made.up is None else f"; up is {' '.join(f'{part:.3f}' for part in made.up)}"
    if made.metres_per_unit is None:
        return f"{map_folder}: its scale is not known{up}"
    sure = "" if made.sigma is None else f" (+- {made.sigma:.2%})"
    return f"{map_folder}: a unit is {made.metres_per_unit:.6g} m{sure}{up}; {map_folder / METRIC} is in metres"
