"""Timing of repeated work, the rows of a benchmark's table, and the name of the processor."""

import platform
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits


@dataclass(frozen=True)
class Measurement:
    """One line of a benchmark's table."""

    name: str
    value: float
    unit: str
    ratio: float | None = None
    """The value over that of `against`: comparable between machines."""
    against: str = ""
    target: str = ""
    """The figure to reach, for display."""
    spread: float | None = None
    """Half the interquartile range over the median of the repetitions."""
    threads: int = 1


@dataclass(frozen=True)
class Timing:
    """Seconds of a few repetitions."""

    best_s: float
    median_s: float
    spread: float


def repeated(work: Callable[[], object], repetitions: int) -> Timing:
    """Time `repetitions` runs after one warm-up run."""
    work()
    times = []
    for _ in range(max(1, repetitions)):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    low, middle, high = np.quantile(times, (0.25, 0.5, 0.75))
    return Timing(min(times), float(middle), float((high - low) / 2 / middle))


def peak_per_second() -> float:
    """Multiply-adds a second of one core in a float32 matrix product, close to the machine's peak."""
    rng = np.random.default_rng(0)
    side = 768
    a, b = rng.normal(size=(2, side, side)).astype(np.float32)
    out = np.empty_like(a)
    with threadpool_limits(1, "blas"):
        seconds = repeated(lambda: np.matmul(a, b, out=out), 10).best_s
    return float(side**3 / seconds)


def processor() -> str:
    """The name of this machine's processor, as its system has it."""
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()
