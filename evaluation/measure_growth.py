"""How accuracy, time and memory grow with the length of a recording, beside the truth.

    .venv/bin/python evaluation/measure_growth.py FOLDER ... [--steps N]

Each FOLDER is the output of `spiked simulate`, of the first frames of one path: more in each. Memory is the largest
anonymous memory of the process: pages of the mapped recording do not count. Exponents are slopes of straight lines
through the logarithms.
"""

import argparse
import json
import math
import os
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

SPIKED = Path(sys.executable).with_name("spiked")
SAMPLE_S = 0.05


@dataclass(frozen=True)
class Run:
    """One reconstruction."""

    frames: int
    figures: dict[str, float]
    tracking_s: float
    cpu_s: float
    memory_mib: float


def anonymous_mib(process: int) -> float:
    """Anonymous memory of a process; 0 once it has ended."""
    try:
        status = Path(f"/proc/{process}/status").read_text(encoding="ascii").splitlines()
    except (FileNotFoundError, ProcessLookupError):
        return 0.0
    return next((int(line.split()[1]) / 1024 for line in status if line.startswith("RssAnon")), 0.0)


def measure(folder: Path, more: list[str]) -> Run:
    """Reconstruct and evaluate the recording in a folder."""
    recording = next(folder.glob("*.dat"))
    with tempfile.TemporaryDirectory() as scratch:
        out = Path(scratch) / "out"
        command = [str(SPIKED), "reconstruct", str(recording), "-o", str(out), *more]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        peak = 0.0
        while not (ended := os.wait4(process.pid, os.WNOHANG))[0]:
            peak = max(peak, anonymous_mib(process.pid))
            time.sleep(SAMPLE_S)
        _, status, usage = ended
        if status != 0:
            raise SystemExit(f"{' '.join(command)} failed with status {os.waitstatus_to_exitcode(status)}")
        score = Path(scratch) / "score.json"
        command = [str(SPIKED), "evaluate", str(out), "--recording", str(recording), "--json", str(score)]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        report = json.loads((out / "report.json").read_text())
        return Run(
            report["frames"],
            json.loads(score.read_text()),
            report["seconds"]["tracking"],
            usage.ru_utime + usage.ru_stime,
            peak,
        )


def exponent(frames: list[int], values: list[float]) -> float:
    """Slope of the logarithm of the values over that of the frames."""
    return statistics.linear_regression([math.log(n) for n in frames], [math.log(v) for v in values]).slope


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--steps", help="as of `spiked reconstruct`")
    options = parser.parse_args()
    more = [] if options.steps is None else ["--steps", options.steps]
    print("| frames | coverage | ATE % | PSNR dB | worst view | tracking s | CPU s | anonymous memory MiB |")
    print("|---|---|---|---|---|---|---|---|", flush=True)
    runs = []
    for folder in options.folders:
        run = measure(folder, more)
        runs.append(run)
        f = run.figures
        print(
            f"| {run.frames} | {f['coverage']:.4f} | {f['ate_percent']:.3f} | {f['psnr_db']:.2f} "
            f"| {f['worst_psnr_db']:.2f} | {run.tracking_s:.1f} | {run.cpu_s:.0f} | {run.memory_mib:.0f} |",
            flush=True,
        )
    if len(runs) > 1:
        frames = [run.frames for run in runs]
        tracking, memory = ([getattr(run, name) for run in runs] for name in ("tracking_s", "memory_mib"))
        print(f"\nexponents: tracking {exponent(frames, tracking):.2f}, memory {exponent(frames, memory):.2f}")


if __name__ == "__main__":
    main()
