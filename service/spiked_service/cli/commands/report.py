"""`spiked report`: one file that shows a result, and a bundle with all that belongs to it."""

from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import typer

from spiked.recon.checkpoint_file import CHECKPOINT, exists
from spiked_service.cli import outputs
from spiked_service.cli.console import output
from spiked_service.results.report.bundle import bundle_pieces
from spiked_service.results.report.folder import FolderReport
from spiked_service.results.report.interrupted import is_of_interrupted_run, results_on_the_way
from spiked_service.results.report.page import report_html
from spiked_service.results.report.source import ReportSource

HTML, BUNDLE = "report.html", "bundle.zip"
"""Names of the files in the folder of the result."""


def report(
    result: Annotated[
        Path, typer.Argument(metavar="OUT", help="Output folder of `spiked reconstruct`, `localise` or `merge`.")
    ],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="File to write. Default: OUT/report.html or OUT/bundle.zip.")
    ] = None,
    bundle: Annotated[
        bool, typer.Option("--zip", help="Write a ZIP with report, scene, trajectory in four formats and pictures.")
    ] = False,
    recording: Annotated[
        Path | None,
        typer.Option(help="The recording, if it is not where the run found it: for pictures and the sidecar."),
    ] = None,
    with_recording: Annotated[bool, typer.Option("--with-recording", help="Also put its frames into the ZIP.")] = False,
    evaluation: Annotated[
        Path | None, typer.Option(help="Figures of `spiked evaluate --json`. Default: OUT/evaluation.json if there.")
    ] = None,
) -> None:
    """Write a report of a result: one HTML file with pictures, plots and all figures, which opens offline.

    With `--zip` a bundle to share: the report, scene.ply, the trajectory for TUM, KITTI, COLMAP and nerfstudio,
    report.json, the pictures and the sidecar of the recording. No folder of this machine is named in it.

    If the run was interrupted, the report says so and has what there was; of a run that was killed, what its last
    checkpoint has.

    Examples:

    - `spiked report out`

    - `spiked evaluate out --recording room/simulated.dat --json out/evaluation.json && spiked report out`

    - `spiked report out --zip -o living.zip`
    """
    file = out or result / (BUNDLE if bundle else HTML)
    outputs.try_file("--out", file)
    if with_recording and not bundle:
        raise typer.BadParameter("it is for a bundle: give --zip, too", param_hint="--with-recording")
    with ExitStack() as kept:
        made = None
        if exists(result / CHECKPOINT) and not is_of_interrupted_run(result):
            made = kept.enter_context(results_on_the_way(result, recording))
        source = FolderReport(result, recording, evaluation, with_recording, made).read()
        _write(source, file, bundle)
    output.print(f"{file}: {file.stat().st_size / 1e6:.1f} MB", markup=False)
    if source.incomplete is not None:
        output.print(source.incomplete, markup=False)


def _write(source: ReportSource, file: Path, bundle: bool) -> None:
    pieces = bundle_pieces(source) if bundle else [report_html(source).encode("utf-8", "replace")]
    part = file.with_name(f".{file.name}.part")
    with outputs.writing("--out", file):
        try:
            with part.open("wb") as written:
                for piece in pieces:
                    written.write(piece)
            part.replace(file)
        finally:
            part.unlink(missing_ok=True)
