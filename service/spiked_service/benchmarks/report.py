"""Rows of a benchmark, and the machine that they were measured on."""

import os
import platform
import statistics
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from spiked.native._raster import multiply_adds


@dataclass(frozen=True)
class Row:
    """One measurement."""

    name: str
    value: float
    unit: str
    ratio: float | None = None
    """A number that can be compared between machines; `against` says with what."""
    against: str = ""
    target: str = ""
    """What the ratio or the value should reach, where that is agreed."""
    spread: float | None = None
    """Half the distance between the quartiles over the median, where it was measured more than twice."""
    threads: int = 1


@dataclass(frozen=True)
class Timing:
    """Seconds of one piece of work, measured a few times."""

    best_s: float
    median_s: float
    spread: float


def timed(work: Callable[[], object], repetitions: int = 7) -> Timing:
    """After one run to warm up."""
    work()
    times = []
    for _ in range(max(2, repetitions)):
        begin = time.perf_counter()
        work()
        times.append(time.perf_counter() - begin)
    low, middle, high = statistics.quantiles(times, n=4)
    return Timing(min(times), middle, (high - low) / 2 / middle)


@dataclass(frozen=True)
class Machine:
    """Where the figures come from."""

    processor: str
    cores: int
    system: str
    load: float
    """Load average of the last minute when the measurements began."""
    multiply_adds_per_s: float
    """Fused multiply-adds of one core, all vector lanes counted."""
    copy_bytes_per_s: float
    """Of one core copying 64 MiB."""

    @classmethod
    def here(cls) -> "Machine":
        """This machine, with its peaks measured."""
        load = os.getloadavg()[0]
        done = float(multiply_adds(1000))
        peak = timed(lambda: multiply_adds(500_000), 5).best_s
        source = np.ones(64 << 20, np.uint8)
        target = np.empty_like(source)
        copy = timed(lambda: np.copyto(target, source), 5).best_s
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        system = f"{platform.system()} {platform.machine()}, Python {platform.python_version()}"
        return cls(_processor(), cores, system, load, done * 500 / peak, source.nbytes / copy)


def _processor() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def text(machine: Machine, rows: list[Row]) -> list[str]:
    """Lines for people."""
    peaks = f"{machine.multiply_adds_per_s * 1e-9:.1f}e9 multiply-adds/s and {machine.copy_bytes_per_s * 1e-9:.1f} GB/s"
    lines = [f"{machine.processor}, {machine.cores} cores, {machine.system}, load {machine.load:.1f}: {peaks} a core"]
    for row in rows:
        spread = "" if row.spread is None else f"+-{100 * row.spread:.0f}%"
        ratio = "" if row.ratio is None else f"{row.ratio:.3g} {row.against}"
        target = f"  [{row.target}]" if row.target else ""
        lines.append(f"{row.name:54s} {row.threads:2d} {row.value:10.4g} {row.unit:9s} {spread:7s} {ratio}{target}")
    return lines


def document(machine: Machine, rows: list[Row]) -> dict[str, Any]:
    """The same for programs."""
    return {"machine": asdict(machine), "rows": [asdict(row) for row in rows]}
