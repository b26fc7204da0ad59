"""The table of a run, and the zip with what may be shared."""

import csv
import io
import json
import os
import platform
import zipfile
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from pydantic import BaseModel, Field

from spiked.datasets import DatasetKind
from spiked.lpips import LPIPS_NETWORK
from spiked_service.base.version import installed_version

COLUMNS = {
    "frames": "frames",
    "poses": "poses",
    "coverage": "coverage",
    "ate_percent": "ATE %",
    "rpe_t_percent": "RPE_t %",
    "rpe_r_deg": "RPE_r deg",
    "psnr_db": "PSNR dB",
    "ssim": "SSIM",
    "lpips": "LPIPS",
    "seconds": "seconds",
}
"""Figures of a row, and their headings."""
_SHARED = ("overview.png", "trajectory.tum", "report.json", "score.json")
"""Files of a result that the zip takes; scene.ply is left out for its size."""
_PACKAGES = ("numpy", "opencv-python-headless", "scipy")


class Row(BaseModel):
    """A recording of the run, when it is finished."""

    name: str
    outcome: str
    """complete, or why there is no path."""
    figures: dict[str, float] = Field(default_factory=dict)
    notes: list[str] = Field(default_factory=list)


@dataclass(frozen=True)
class Table:
    """All rows, with what they are of."""

    kind: DatasetKind
    options: list[str]
    rows: list[Row] = field(default_factory=list)

    def markdown(self) -> str:
        """A page with the table, the notes, the versions and the machine."""
        lines = [f"# {self.kind.title}", ""]
        lines += [f"`spiked datasets run {self.kind.name} ... {' '.join(self.options)}`".replace(" `", "`"), ""]
        lines += ["| recording | " + " | ".join(COLUMNS.values()) + " | outcome |", "|---" * (len(COLUMNS) + 2) + "|"]
        for row in self.rows:
            cells = [_cell(name, row.figures.get(name)) for name in COLUMNS]
            lines.append(f"| {_escaped(row.name)} | " + " | ".join(cells) + f" | {_escaped(row.outcome)} |")
        lines += ["", "Figures are those of `spiked evaluate`; empty where the data set says no truth.", ""]
        if any("lpips" in row.figures for row in self.rows):
            lines += [f"LPIPS by {LPIPS_NETWORK}; smaller is better.", ""]
        notes = [f"* {_escaped(note)}" for row in self.rows for note in row.notes]
        lines += [*notes, ""] if notes else []
        lines += [f"Layout: {self.kind.certainty}. Licence of the data: {self.kind.licence}.", ""]
        lines += [f"Cite: {self.kind.citation}", ""]
        lines += [", ".join(f"{name} {value}" for name, value in versions().items()), ""]
        return "\n".join(lines)

    def csv(self) -> str:
        """The same rows for other programs."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(["recording", *COLUMNS, "outcome"])
        for row in self.rows:
            writer.writerow([row.name, *(row.figures.get(name, "") for name in COLUMNS), row.outcome])
        return text.getvalue()


def versions() -> dict[str, str]:
    """Versions that results depend on, and the machine."""
    found = {"spiked": installed_version(), "python": platform.python_version()}
    for package in _PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "unknown"
    cores = len(os.sched_getaffinity(0))
    return found | {"system": f"{platform.system()} {platform.machine()}", "cores": str(cores)}


def write_zip(path: Path, table: Table, results: dict[str, Path]) -> None:
    """Write the zip: table, versions, and of each result the report, picture, trajectory and figures. Raises OSError.

    `results` are the folders of the recordings by their names. There is no recording and no scene in it.
    """
    temporary = path.with_name(path.name + ".part")
    with zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("table.md", table.markdown())
        archive.writestr("table.csv", table.csv())
        archive.writestr("versions.json", json.dumps(versions(), indent=1))
        for name, folder in results.items():
            for file in _SHARED:
                if (folder / file).is_file():
                    archive.write(folder / file, f"{name}/{file}")
    temporary.replace(path)


def _cell(name: str, value: float | None) -> str:
    if value is None:
        return ""
    return f"{value:.0f}" if name in ("frames", "poses", "seconds") else f"{value:.4g}"


def _escaped(text: str) -> str:
    return " ".join(text.replace("|", "\\|").split())
