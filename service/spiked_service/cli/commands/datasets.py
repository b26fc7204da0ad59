"""`spiked datasets`: public data sets: what there are, whether a folder is whole, and a run over all of it."""

import shlex
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn
from rich.table import Table
from rich.text import Text

from spiked.datasets import KINDS, Clip, Comparison, Dataset, DatasetKind, compare, find_kind, recognise
from spiked.errors import ConfigurationError
from spiked_service.cli import outputs
from spiked_service.cli.console import messages, output, report_error, report_warning
from spiked_service.cli.dataset_runs.children import INTERRUPTED
from spiked_service.cli.dataset_runs.run import DatasetRun, InterruptedRunError

datasets = typer.Typer(help="Public data sets: list, check and reconstruct them.", invoke_without_command=True)

Name = Annotated[str, typer.Argument(help="Name of a data set, as `spiked datasets` lists them.")]
Folder = Annotated[Path, typer.Argument(help="Folder of the data set, unpacked.")]


@datasets.callback()
def listing(context: typer.Context) -> None:
    """List the data sets that are read: name, sensor, licence, size, where the authors publish them, how to get them.

    Nothing is downloaded: get the files where the authors publish them, unpack them, and name the folder.

    Examples:

    - `spiked datasets`

    - `spiked datasets show usp-gaussian`

    - `spiked datasets check downloads/sheep`

    - `spiked datasets run usp-gaussian downloads/sheep -o sheep --steps 2000`
    """
    if context.invoked_subcommand is not None:
        return
    for kind in KINDS:
        output.print(f"[bold]{kind.name}[/bold]", highlight=False)
        grid = Table.grid(padding=(0, 2))
        for label, text in _summary(kind):
            grid.add_row(f"  {label}", Text(text))
        output.print(grid, soft_wrap=False)
    messages.print("`spiked datasets show NAME` prints the layout, how it is known, and what to cite", markup=False)


@datasets.command()
def show(name: Name) -> None:
    """Print all that is known of a data set: with its layout, how that is known, and what to cite."""
    kind = find_kind(name)
    output.print(kind.title, style="bold", markup=False)
    rows = [*_summary(kind)[1:], ("layout", kind.layout.strip()), ("known", kind.certainty), ("cite", kind.citation)]
    grid = Table.grid(padding=(0, 2))
    for label, text in rows:
        grid.add_row(label, Text(text))
    output.print(grid, soft_wrap=False)


def _summary(kind: DatasetKind) -> list[tuple[str, str]]:
    return [
        ("", kind.title),
        ("sensor", kind.sensor),
        ("licence", kind.licence),
        ("size", kind.size),
        ("published", kind.published),
        ("to get it", kind.get),
        ("then", f"spiked datasets run {kind.name} FOLDER -o OUT"),
    ]


@datasets.command()
def check(
    folder: Folder,
    name: Annotated[str | None, typer.Option("--as", help="Name of the data set. Default: recognised.")] = None,
) -> None:
    """Read all of a folder: its clips and scenes, missing and damaged files, and checksums.

    The first look records the SHA-256 of each file, in the folder or in the user's data folder; every later one
    compares, and exits with 2 for a file that has changed or is gone.
    """
    kind = _kind(folder, name)
    dataset = kind.open(folder)
    for item in dataset.items:
        output.print(_described(item), markup=False)
        for note in item.notes if isinstance(item, Clip) else ():
            report_warning(note)
    compared = _compared(dataset)
    compared.raise_if_changed(dataset.folder)
    size = sum(path.stat().st_size for path in dataset.files)
    state = "recorded in" if compared.is_new else f"as on {compared.recorded:%Y-%m-%d}, by"
    output.print(
        f"{kind.name}: {len(dataset.items)} recordings, {len(dataset.files)} files, {size / 1e6:.1f} MB; checksums "
        f"{state} {compared.path}",
        markup=False,
    )


@datasets.command(context_settings={"allow_extra_args": True, "ignore_unknown_options": True})
def run(
    context: typer.Context,
    name: Name,
    folder: Folder,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the results; created if missing.")],
    simulate: Annotated[
        str, typer.Option(help="Options for `spiked simulate`, in quotes: of sets of pictures, whose spikes it makes.")
    ] = "",
    only: Annotated[list[str] | None, typer.Option(help="Name of a recording; may be repeated. Default: all.")] = None,
    keep_recordings: Annotated[
        bool, typer.Option("--keep-recordings", help="Keep recordings that were converted or simulated.")
    ] = False,
    retry: Annotated[bool, typer.Option("--retry", help="Reconstruct again what failed before.")] = False,
) -> None:
    """Reconstruct every recording of a data set and score what truth there is.

    All further options go to `spiked reconstruct`. OUT has table.md and table.csv, a folder of results for each
    recording, and NAME.zip to share: tables, reports, pictures, trajectories and versions, without recordings and
    scenes. A run that was killed goes on if the same command is given again; finished recordings are kept, unless a
    file of theirs has changed.

    Exits with 1 if a recording could not be reconstructed.

    Examples:

    - `spiked datasets run recvidarreal downloads/recVidarReal2019 -o real --fov 30`

    - `spiked datasets run tanks-and-temples tanks -o tanks-out --simulate "--width 640 --mosaic RGGB" --steps 2000`
    """
    kind = find_kind(name)
    dataset = _chosen(kind.open(folder), only)
    for item in dataset.items:
        for note in item.notes if isinstance(item, Clip) else ():
            report_warning(note)
    work = DatasetRun(kind, dataset, out, list(context.args), shlex.split(simulate), keep_recordings, retry, _say)
    work.begin()
    try:
        with outputs.alone("--out", out, "run of a data set"):
            _compared(dataset).raise_if_changed(dataset.folder)
            table = work.carry_out()
    except InterruptedRunError as error:
        report_error(error)
        raise typer.Exit(INTERRUPTED) from error
    output.print(table.markdown().split("\n\nFigures")[0].split("\n\n")[-1], markup=False)
    output.print(f"{out / 'table.md'}, {out / (kind.name + '.zip')}", markup=False)
    if any(row.outcome != "complete" for row in table.rows):
        raise typer.Exit(1)


def _say(line: str) -> None:
    messages.print(line, markup=False)


def _kind(folder: Path, name: str | None) -> DatasetKind:
    if name is not None:
        return find_kind(name)
    first, *others = recognise(folder)
    if others:
        also = ", ".join(kind.name for kind in others)
        messages.print(f"read as {first.name}; it may also be {also} (--as)", markup=False)
    return first


def _chosen(dataset: Dataset, only: list[str] | None) -> Dataset:
    if not only:
        return dataset
    names = [item.name for item in dataset.items]
    for name in only:
        if name not in names:
            raise ConfigurationError(f"--only {name}: there is no such recording; there are {', '.join(names)}")
    return dataset.of([item for item in dataset.items if item.name in only])


def _described(item: object) -> str:
    if isinstance(item, Clip):
        sensor = item.sensor
        truth = [] if item.truth.path is None else [f"{len(item.truth.path)} true poses"]
        truth += [f"{len(item.truth.views)} views"] if item.truth.views else []
        dead = [] if item.dead is None else [f"{int(item.dead.sum())} pixels left out"]
        colour = "grey" if sensor.mosaic is None else sensor.mosaic
        parts = [f"{item.frames} frames of {sensor.width}x{sensor.height}", f"{sensor.frame_rate_hz:g} Hz", colour]
        return f"{item.name}: {', '.join([*parts, *dead, *truth])}"
    name, count = getattr(item, "name", ""), len(getattr(item, "pictures", ()))
    return f"{name}: {count} pictures of {getattr(item, 'width', 0)}x{getattr(item, 'height', 0)} with poses"


def _compared(dataset: Dataset) -> Comparison:
    columns = (TextColumn("checksums"), BarColumn(bar_width=28), DownloadColumn())
    with Progress(*columns, console=messages, transient=True, disable=not messages.is_terminal) as bar:
        task = bar.add_task("checksums", total=None)
        return compare(dataset, lambda done, total: bar.update(task, completed=done, total=total))
