"""`spiked compare`: methods x recordings x seeds x metrics, as tables and a page with pictures."""

import os
import platform
import signal
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from spiked.errors import ConfigurationError, SpikedError
from spiked.recording import open_recording
from spiked.whole_files import write_atomically
from spiked_service.base.signals import handling
from spiked_service.base.version import installed_version
from spiked_service.cli import outputs
from spiked_service.cli.commands.reconstruct import INTERRUPTED
from spiked_service.cli.comparison.cells import Cell, Outcome, run_cell, stored
from spiked_service.cli.comparison.page import page
from spiked_service.cli.comparison.pictures import Strip, strips
from spiked_service.cli.comparison.rows import GROUPS, chosen, rows
from spiked_service.cli.comparison.tables import csv_text, markdown
from spiked_service.cli.console import messages, output, report_warning

TABLE, FIGURES, PAGE = "comparison.md", "comparison.csv", "comparison.html"
"""Files in OUT."""


def compare(
    files: Annotated[list[Path] | None, typer.Argument(help="Recordings.", metavar="RECORDING...")] = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Folder for tables, page and cells.")] = None,
    methods: Annotated[
        str, typer.Option(help="Rows or groups of rows, with commas; --list shows them.")
    ] = "spiked,baselines",
    row: Annotated[
        list[str] | None,
        typer.Option(help="A row of your own, NAME=COMMAND OPTIONS, with `reconstruct` or `baseline`; repeatable."),
    ] = None,
    seeds: Annotated[int, typer.Option(help="Seeds 0 to N - 1 of each row.", min=1)] = 1,
    steps: Annotated[
        int | None, typer.Option(help="Gradient steps of each map; each method's own if not given.", min=0)
    ] = None,
    limit: Annotated[float | None, typer.Option(help="Seconds of a cell; one that takes longer failed.", min=1)] = None,
    retry: Annotated[bool, typer.Option("--retry", help="Run cells again that failed before.")] = False,
    list_rows: Annotated[bool, typer.Option("--list", help="List rows and groups, and exit.")] = False,
) -> None:
    """Run methods on recordings and make the tables: comparison.md, comparison.csv and comparison.html in OUT.

    A cell is one method on one recording with one seed, in a process of its own, scored by `spiked evaluate` if the
    truth lies beside the recording; without truth the tables have times and memory, and the page its pictures. Finished
    cells are kept in OUT/cells: a command that was interrupted or killed goes on where it was when it is given again,
    and one with more rows, recordings or seeds runs only these. Cells of a recording whose file, calibration or truth
    has changed are run again. A cell that failed is a row that says why; the command then ends with exit code 1. The
    page shows what was observed, what each method renders, and the truth.

    Examples:

    - `spiked compare living.dat garden.dat --seeds 3 -o tables`

    - `spiked compare rec.dat --methods spiked,colmap-tfp --row "few=reconstruct --max-views 100" -o tables`

    - `spiked compare --list`
    """
    if list_rows:
        _list()
        return
    if not files or out is None:
        raise ConfigurationError("name recordings, and a folder for the tables (-o OUT); --list shows the rows")
    outputs.try_folder("--out", out, (TABLE, FIGURES, PAGE))
    wanted = chosen([name for name in methods.split(",") if name], row or [])
    names = _names(files)
    for file in files:
        open_recording(file)
    cells = [
        Cell(file.absolute(), names[file], one, seed, steps)
        for file in files for one in wanted for seed in range(seeds)
    ]  # fmt: skip
    with outputs.writing("--out", out), outputs.alone("--out", out, "comparison"), _interruptible():
        outcomes = _run(cells, out, limit, retry)
        _write_page(cells, outcomes, out)
    failed = sum(outcome.reason is not None for outcome in outcomes.values())
    output.print(f"{out / PAGE}: {len(cells)} cells, {failed} failed", markup=False)
    if failed:
        raise typer.Exit(1)


def _run(cells: list[Cell], out: Path, limit_s: float | None, retry: bool) -> dict[Cell, Outcome]:
    """The outcome of each cell, from an earlier run where there is one. Tables are written after each new one."""
    outcomes = {cell: outcome for cell in cells if (outcome := stored(cell, out)) is not None}
    if (out / PAGE).exists() and len(outcomes) < len(cells):
        _write_page(cells, outcomes, out)  # the one that is there may be of other recordings
    for number, cell in enumerate(cells, 1):
        outcome = outcomes.get(cell)
        kept = outcome is not None and not (retry and outcome.reason is not None)
        what = f"{number}/{len(cells)} {cell.name}, {cell.row.name}, seed {cell.seed}"
        if outcome is None or not kept:
            messages.print(what, markup=False)
            outcome = outcomes[cell] = run_cell(cell, out, limit_s)
        shown = _in_order(cells, outcomes)
        write_atomically(out / TABLE, markdown(shown).encode())
        write_atomically(out / FIGURES, csv_text(shown).encode())
        said = "kept" if kept else f"{outcome.seconds:.0f} s"
        if outcome.reason is not None:
            report_warning(f"{what}: failed ({said}): {outcome.reason}")
        else:
            messages.print(f"{what}: {said}{_shown(outcome)}", markup=False)
    return outcomes


def _in_order(cells: list[Cell], outcomes: dict[Cell, Outcome]) -> list[Outcome]:
    return [outcomes[cell] for cell in cells if cell in outcomes]


def _write_page(cells: list[Cell], outcomes: dict[Cell, Outcome], out: Path) -> None:
    """The page, from the cells of the first seed that did not fail."""
    found: dict[str, list[Strip]] = {}
    for recording in dict.fromkeys(cell.recording for cell in cells):
        folders: dict[str, Path] = {}
        of_it = [cell for cell in cells if cell.recording == recording]
        for cell in of_it:
            if cell in outcomes and outcomes[cell].reason is None:
                folders.setdefault(cell.row.name, out / cell.place)
        try:
            found[of_it[0].name] = strips(open_recording(recording), folders)
        except SpikedError as error:
            report_warning(f"no pictures of {recording.name}: {error}")
    shown = _in_order(cells, outcomes)
    write_atomically(out / PAGE, page(shown, found, _summary(shown)).encode())


def _summary(outcomes: list[Outcome]) -> list[str]:
    """Which versions made the cells, and where the page was written: kept cells may be of another machine."""
    versions = dict.fromkeys(outcome.version or "unknown" for outcome in outcomes)
    cpuinfo = Path("/proc/cpuinfo")
    models = [line.split(":", 1)[1].strip() for line in cpuinfo.read_text().splitlines() if "model name" in line]
    model = models[0] if models else platform.machine()
    made = f"cells by spiked {', '.join(versions) or installed_version()}"
    return [made, f"page written on {model}, {len(os.sched_getaffinity(0))} cores, {platform.system()}"]


def _shown(outcome: Outcome) -> str:
    parts = (("ate_percent", "ATE {:.3f} %"), ("psnr_db", "PSNR {:.2f} dB"))
    return "".join(f", {text.format(outcome.figures[key])}" for key, text in parts if key in outcome.figures)


def _names(files: list[Path]) -> dict[Path, str]:
    """A name in the tables for each recording: its own, with its folder's where two have the same.

    Raises ConfigurationError.
    """
    stems = Counter(file.stem for file in files)
    names = {
        file: file.stem if stems[file.stem] == 1 else f"{file.absolute().parent.name}-{file.stem}" for file in files
    }
    if len(set(names.values())) < len(files):
        raise ConfigurationError("two of the recordings have the same name and folder; rename one, or name it once")
    return names


@contextmanager
def _interruptible() -> Iterator[None]:
    """Ctrl-C and SIGTERM end the method that runs, and the command with exit code 130."""
    with handling(dict.fromkeys((signal.SIGINT, signal.SIGTERM), signal.default_int_handler)):
        try:
            yield
        except KeyboardInterrupt as error:
            messages.print("interrupted; the same command goes on where it was")
            raise typer.Exit(INTERRUPTED) from error


def _list() -> None:
    width = max(len(name) for name in rows())
    for group, members in GROUPS.items():
        output.print(f"{group}:", markup=False)
        for one in members:
            output.print(f"  {one.name:{width}s}  {one.summary}", markup=False)
            output.print(f"  {'':{width}s}  {' '.join(one.arguments)}", markup=False, style="dim")
