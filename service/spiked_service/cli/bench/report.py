"""The table of a benchmark, and the machine that it was measured on."""

import os
import platform
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from spiked.measurement import Measurement, peak_per_second, processor, repeated
from spiked.render.cpu import usable_cores


@dataclass(frozen=True)
class Machine:
    """The machine that was measured."""

    processor: str
    cores: int
    system: str
    load: float
    """Load average of the last minute when the measurements began."""
    multiply_adds_per_s: float
    """Multiply-adds a second of one core, in a product of float32 matrices."""
    copy_bytes_per_s: float
    """Bytes a second of one core, copying 64 MiB."""

    @classmethod
    def here(cls) -> "Machine":
        """This machine, with its peaks measured."""
        load = os.getloadavg()[0]
        source = np.ones(64 << 20, np.uint8)
        target = np.empty_like(source)
        copy = repeated(lambda: np.copyto(target, source), 5).best_s
        system = f"{platform.system()} {platform.machine()}, Python {platform.python_version()}"
        return cls(processor(), usable_cores(), system, load, peak_per_second(), source.nbytes / copy)


def text(machine: Machine, rows: list[Measurement]) -> list[str]:
    """The table as text lines."""
    peaks = f"{machine.multiply_adds_per_s * 1e-9:.1f}e9 multiply-adds/s and {machine.copy_bytes_per_s * 1e-9:.1f} GB/s"
    lines = [f"{machine.processor}, {machine.cores} cores, {machine.system}, load {machine.load:.1f}: {peaks} a core"]
    for row in rows:
        spread = "" if row.spread is None else f"+-{100 * row.spread:.0f}%"
        ratio = "" if row.ratio is None else f"{row.ratio:.3g} {row.against}"
        target = f"  [{row.target}]" if row.target else ""
        lines.append(f"{row.name:54s} {row.threads:2d} {row.value:10.4g} {row.unit:9s} {spread:7s} {ratio}{target}")
    return lines


def document(machine: Machine, rows: list[Measurement]) -> dict[str, Any]:
    """The table as a JSON document."""
    return {"machine": asdict(machine), "rows": [asdict(row) for row in rows]}
