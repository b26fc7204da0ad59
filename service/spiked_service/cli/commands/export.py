"""`spiked export`: a result in the format of another program."""

import inspect
from pathlib import Path
from typing import Annotated, Literal

import typer

from spiked.errors import ConfigurationError
from spiked.export import KINDS, ExportKind, ExportOptions, ExportSource, find_kind
from spiked.export.source import KEY_VIEWS
from spiked.scene import Scene
from spiked.spz import decode
from spiked_service.base.signals import holding
from spiked_service.cli import outputs
from spiked_service.cli.console import output
from spiked_service.results.report.folder import FolderReport
from spiked_service.results.scene_scale import known_frame

_FORMATS = "\n\n".join(f"- `{kind.name}`: {kind.title}. For {kind.readers}." for kind in KINDS)


def _kind(name: str) -> ExportKind:
    try:
        return find_kind(name)
    except ConfigurationError as error:
        raise typer.BadParameter(str(error)) from error


_Kind = Annotated[ExportKind, typer.Argument(metavar="FORMAT", help="One of those above.", parser=_kind)]


_Recording = Annotated[
    Path | None, typer.Option(help="The recording, if it is not where the run found it: for pictures and frames.")
]
_Views = Annotated[int, typer.Option(help="Key views: poses of pictures, depth maps and points.", min=1, max=100_000)]
_Frames = Annotated[
    list[int] | None,
    typer.Option(help="A frame that a key view is of, in place of --views; may be given again.", min=0),
]
_Undistorted = Annotated[
    bool, typer.Option("--undistorted", help="Pictures, depth maps and cameras without the lens's distortion.")
]
_Expected = Annotated[
    bool,
    typer.Option("--expected-depth", help="Mean depth of what a pixel shows; less exact than the median."),
]
_Resolution = Annotated[
    int, typer.Option(help="Voxels of a mesh along the longest side of the scene.", min=16, max=1024)
]
_Metric = Annotated[bool, typer.Option("--metric", help="In metres, with up along -y, by the scale of `spiked scale`.")]


def export(
    result: Annotated[
        Path,
        typer.Argument(metavar="OUT", help="Output folder of `spiked reconstruct` or `merge`, or a file of splats."),
    ],
    kind: _Kind,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="File or folder to write. Default: OUT/export/FORMAT with the usual ending."),
    ] = None,
    recording: _Recording = None,
    views: _Views = KEY_VIEWS,
    frame: _Frames = None,
    undistorted: _Undistorted = False,
    expected: _Expected = False,
    resolution: _Resolution = 256,
    seconds: Annotated[float, typer.Option(help="Length of a video.", min=0.1, max=3600)] = 10.0,
    metric: _Metric = False,
) -> None:
    """Write a result in the format of another program.

    Pictures, depth maps and points are made at key views, evenly spaced along the path. Poses are camera to world with
    OpenCV's axes unless a format has its own; lengths are in the unit of the scene, or with --metric in metres.
    docs/exports.md says what each format loses. A format whose package is not installed says how to get it.

    Formats:

    (formats)

    OUT may also be a file of splats, .ply or .spz, of any program: the formats of splats are made of it.

    Examples:

    - `spiked export out colmap -o project`

    - `spiked export garden.ply spz -o garden.spz`

    - `spiked export out depth --frame 640 -o depth640`

    - `spiked scale out --length 3.0 1.42 && spiked export out mesh-glb --metric --resolution 384`
    """
    with holding():
        kind.check()
    place = out or _place(result, f"{kind.name}{'-metric' if metric else ''}{kind.suffix}")
    (outputs.try_folder if kind.folder else outputs.try_file)("--out", place)
    source = _source(result, recording, metric)
    depth: Literal["median", "expected"] = "expected" if expected else "median"
    options = ExportOptions(views, undistorted, depth, resolution, seconds, frames=tuple(frame or ()))
    with outputs.writing("--out", place):
        said = kind.write(source, place, options)
    output.print(f"{place}: {said}", markup=False)


export.__doc__ = (inspect.getdoc(export) or "").replace("(formats)", _FORMATS)


def _place(result: Path, name: str) -> Path:
    """Where the export of a result is written by default: in a folder of results, or beside a file of splats."""
    if result.is_file():
        return result.with_name(f"{result.stem}-{name}")
    if result.is_dir():
        with outputs.writing("OUT", result / "export"):
            (result / "export").mkdir(exist_ok=True)
    return result / "export" / name


def _source(result: Path, recording: Path | None, metric: bool) -> ExportSource:
    """What is exported: a folder of results, or the splats of a file."""
    if result.is_file():
        if metric:
            raise ConfigurationError(f"--metric: {result} is a file, and no scale is known of it; name a folder")
        scene = decode(result.read_bytes()) if result.suffix == ".spz" else Scene.read_ply(result)
        return ExportSource.of_splats(scene, result.name)
    source = FolderReport(result, recording).export_source()
    return source.in_frame(known_frame(result)) if metric else source
