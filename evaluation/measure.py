"""Reconstruct streams with known truth and print the README's table.

    .venv/bin/python evaluation/measure.py STREAMS_DIR [NAME ...] [--score SCORE.py] [--runs N] [--keep DIR]

STREAMS_DIR holds folders NAME with NAME.dat, its sidecar, groundtruth.tum, views.json and views/, as `spiked simulate`
writes them. Each row is one `spiked reconstruct` with default options in a process of its own (medians over --runs
seeds); accuracy is from SCORE.py when given, else from `spiked evaluate`.
"""

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

COLUMNS = ("coverage", "ate_percent", "rpe_r_deg", "psnr", "ssim")
SPIKED = Path(sys.executable).with_name("spiked")


def reconstruct(recording: Path, out: Path, seed: int) -> tuple[float, float, float]:
    """Wall seconds, CPU seconds and peak memory in GiB of one reconstruction."""
    begin = time.perf_counter()
    command = [str(SPIKED), "reconstruct", str(recording), "-o", str(out), "--seed", str(seed)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    if status != 0:
        raise SystemExit(f"{' '.join(command)} failed with status {os.waitstatus_to_exitcode(status)}")
    return time.perf_counter() - begin, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 2**20


def score(stream: Path, out: Path, script: Path | None) -> dict[str, float]:
    """The figures of COLUMNS."""
    result = out / "score.json"
    if script is None:
        recording = stream / f"{stream.name}.dat"
        command = [str(SPIKED), "evaluate", str(out), "--recording", str(recording), "--json", str(result)]
    else:
        files = [str(out / "trajectory.tum"), str(out / "scene.ply")]
        command = [sys.executable, str(script), str(stream), *files, "--json", str(result)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    figures = json.loads(result.read_text())
    figures.setdefault("psnr", figures.get("psnr_db"))
    return {column: figures[column] for column in COLUMNS}


def row(stream: Path, script: Path | None, runs: int, keep: Path | None) -> str:
    """One line of the table: medians over seeds."""
    table: list[dict[str, float]] = []
    for seed in range(runs):
        with tempfile.TemporaryDirectory() as scratch:
            out = (keep or Path(scratch)) / stream.name
            wall, cpu, memory = reconstruct(stream / f"{stream.name}.dat", out, seed)
            seconds = json.loads((out / "report.json").read_text())["seconds"]
            figures = score(stream, out, script)
            table.append(figures | {"wall": wall, "cpu": cpu, "memory": memory, "tracking": seconds["tracking"]})
    m = {key: statistics.median(one[key] for one in table) for key in table[0]}
    return (
        f"| {stream.name} | {m['coverage']:.2f} | {m['ate_percent']:.3f} | {m['rpe_r_deg']:.4f} | {m['psnr']:.1f} "
        f"| {m['ssim']:.3f} | {m['tracking']:.1f} | {m['wall']:.0f} | {m['cpu']:.0f} | {m['memory']:.2f} |"
    )


def machine() -> str:
    """The processor's name and the cores that may be used."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        names = [line.split(":", 1)[1].strip() for line in cpuinfo.read_text().splitlines() if "model name" in line]
        model = names[0] if names else model
    return f"{model}, {len(os.sched_getaffinity(0))} cores, {platform.system()} {platform.machine()}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("streams", type=Path)
    parser.add_argument("names", nargs="*", default=["living", "garden"])
    parser.add_argument("--score", type=Path, help="a scoring script: STREAM_DIR TRAJECTORY.tum SCENE.ply --json FILE")
    parser.add_argument("--runs", type=int, default=1, help="seeds 0 to N - 1, medians are shown")
    parser.add_argument("--keep", type=Path, help="keep the results here")
    options = parser.parse_args()
    print("| stream | coverage | ATE % | RPE_r deg | PSNR dB | SSIM | trajectory s | total s | CPU s | peak GiB |")
    print("|---|---|---|---|---|---|---|---|---|---|", flush=True)
    for name in options.names:
        print(row(options.streams / name, options.score, options.runs, options.keep), flush=True)
    print(f"\n{machine()}; load average while measuring {os.getloadavg()[0]:.1f}")


if __name__ == "__main__":
    main()
