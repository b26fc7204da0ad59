"""The outcomes of a comparison as tables: medians over seeds in Markdown, a line for each cell in CSV."""

import csv
import io
import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from spiked.lpips import LPIPS_NETWORK
from spiked_service.cli.comparison.cells import Outcome


@dataclass(frozen=True)
class Column:
    """A figure of the tables."""

    key: str
    """Its name in `Outcome.figures`, or that of a field of `Outcome`."""
    heading: str
    digits: int

    def value(self, outcome: Outcome) -> float | None:
        """The figure of a cell, None if it has none."""
        if self.key in _MEASURED:
            return float(getattr(outcome, self.key)) if outcome.seconds else None
        return outcome.figures.get(self.key)

    def median(self, outcomes: Sequence[Outcome]) -> float | None:
        """The median of the cells that have it."""
        values = [value for outcome in outcomes if (value := self.value(outcome)) is not None]
        return statistics.median(values) if values else None

    def text(self, outcomes: Sequence[Outcome]) -> str:
        """Its median, and the least and largest of several seeds."""
        values = [value for outcome in outcomes if (value := self.value(outcome)) is not None]
        if not values:
            return ""
        middle = f"{statistics.median(values):.{self.digits}f}"
        if len(values) == 1:
            return middle
        return f"{middle} ({min(values):.{self.digits}f}-{max(values):.{self.digits}f})"


_MEASURED = "seconds", "cpu_s", "peak_gib"
COLUMNS = (
    Column("coverage", "coverage", 2),
    Column("ate_percent", "ATE %", 3),
    Column("rpe_r_deg", "RPE_r deg", 4),
    Column("rpe_t_percent", "RPE_t %", 3),
    Column("ate_unit", "ATE unit", 5),
    Column("rpe_r_unit_deg", "RPE_r unit deg", 4),
    Column("rpe_t_unit", "RPE_t unit", 3),
    Column("psnr_db", "PSNR dB", 2),
    Column("worst_psnr_db", "worst PSNR dB", 2),
    Column("ssim", "SSIM", 3),
    Column("lpips", "LPIPS", 3),
    Column("seconds", "seconds", 0),
    Column("cpu_s", "CPU s", 0),
    Column("peak_gib", "peak GiB", 2),
)
NOTES = (
    "ATE % is in percent of the RMS radius of the true path after alignment by a similarity; RPE over 32 frames, "
    "translation in percent of the same.",
    "The columns 'unit' are those of the tables of CF-3DGS and InstantSplat: 24 poses on paths of unit norm, RPE from "
    "each to the next, translation in hundredths.",
    "PSNR and SSIM over the held-out views, values in [0, 1], poses refined with the scene held.",
    f"LPIPS by {LPIPS_NETWORK}; smaller is better.",
    "Seconds, CPU seconds and memory are of the method's process, without the scoring. Several seeds: the median, and "
    "least and largest.",
)


def grouped(outcomes: Iterable[Outcome]) -> dict[str, dict[str, list[Outcome]]]:
    """The cells of each row of each recording, in their order."""
    groups: dict[str, dict[str, list[Outcome]]] = {}
    for outcome in outcomes:
        groups.setdefault(outcome.recording, {}).setdefault(outcome.row, []).append(outcome)
    return groups


def columns_of(outcomes: Sequence[Outcome]) -> list[Column]:
    """Those that at least one cell has."""
    return [column for column in COLUMNS if any(column.value(outcome) is not None for outcome in outcomes)]


def failures(outcomes: Sequence[Outcome]) -> list[str]:
    """Why seeds failed, each reason once."""
    found: dict[str, list[int]] = {}
    for outcome in outcomes:
        if outcome.reason is not None:
            found.setdefault(outcome.reason, []).append(outcome.seed)
    many = len(outcomes) > 1
    return [f"{f'seed {_listed(seeds)}: ' if many else ''}{reason}" for reason, seeds in found.items()]


def markdown(outcomes: Sequence[Outcome]) -> str:
    """A table for each recording, and what the columns mean."""
    parts = []
    for recording, rows in grouped(outcomes).items():
        columns = columns_of([outcome for cells in rows.values() for outcome in cells])
        lines = [
            f"## {recording}\n",
            "| method | " + " | ".join([column.heading for column in columns] + ["failed"]) + " |",
            "|" + "---|" * (len(columns) + 2),
        ]
        for row, cells in rows.items():
            texts = [column.text([cell for cell in cells if cell.reason is None]) for column in columns]
            why = "; ".join(failures(cells)).replace("|", "\\|")
            lines.append("| " + " | ".join([row, *texts, why]) + " |")
        parts.append("\n".join(lines) + "\n")
    return "\n".join([*parts, *(f"{note}\n" for note in NOTES)])


def csv_text(outcomes: Iterable[Outcome]) -> str:
    """A line for each cell, with all figures unrounded."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(
        ["recording", "method", "seed", *(column.key for column in COLUMNS), "failed", "version", "command"]
    )
    for outcome in outcomes:
        values = (column.value(outcome) for column in COLUMNS)
        figures = ["" if value is None else repr(value) for value in values]
        last = [outcome.reason or "", outcome.version, " ".join(outcome.command)]
        writer.writerow([outcome.recording, outcome.row, outcome.seed, *figures, *last])
    return file.getvalue()


def _listed(numbers: Sequence[int]) -> str:
    return ", ".join(str(number) for number in numbers)
