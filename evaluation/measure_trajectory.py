"""Time to answer a request for a range of a long trajectory: `python evaluation/measure_trajectory.py [POSES]`.

Writes a pose file of 10 million poses (720 MB) into a temporary folder, and asks for ranges of it as the route of
trajectories does, without the network. Prints milliseconds to the first bytes and to the last.
"""

import asyncio
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from fastapi import Request
from spiked_service.api.trajectories import Range, TrajectoryFormat, trajectory_response
from spiked_service.base.limits import ConcurrencyLimit

from spiked.poses import PoseAppender, PoseFile
from spiked.sensor import Intrinsics, Sensor

SENSOR = Sensor(400, 250, 20_000.0, intrinsics=Intrinsics.from_fov(400, 250, 60))
CHUNK = 1_000_000


def write(path: Path, count: int) -> None:
    """A file of poses that differ in every digit."""
    rng = np.random.default_rng(1)
    with PoseAppender(path) as out:
        for first in range(0, count, CHUNK):
            table = rng.normal(size=(min(CHUNK, count - first), 8))
            table[:, 0] = (first + np.arange(len(table)) + 0.5) / SENSOR.frame_rate_hz
            out.append_table(table, np.full(len(table), b"track"))


async def answer(path: Path, kind: TrajectoryFormat, part: Range) -> tuple[float, float, int]:
    """Milliseconds to the first bytes and to the last, and their number; the file is opened anew, as for a request."""
    request = Request({"type": "http", "method": "GET", "path": "/", "headers": []})
    started = time.perf_counter()
    response = trajectory_response(request, PoseFile(path), 1, SENSOR, kind, part, ConcurrencyLimit("trajectories", 8))
    first, size = 0.0, 0
    async for piece in response.body_iterator:  # type: ignore[attr-defined]
        first = first or time.perf_counter() - started
        size += len(piece)
    return 1e3 * first, 1e3 * (time.perf_counter() - started), size


def main() -> None:
    """Print a table."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 10_000_000
    seconds = count / SENSOR.frame_rate_hz
    middle = seconds / 2
    asked = {
        "1,280 in the middle": Range(middle, middle + 0.064, 1),
        "20,000 in the middle": Range(middle, middle + 1, 1),
        "all, every 500th": Range(None, None, 500),
        "all, every 64th": Range(None, None, 64),
        "the last second": Range(seconds - 1, None, 1),
    }
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "trajectory.poses"
        write(path, count)
        print(f"{count:,} poses, {path.stat().st_size / 1e6:.0f} MB; best of five")
        print("| asked for | format | first bytes, ms | all, ms | MB |\n|---|---|---|---|---|")
        for name, part in asked.items():
            for kind in (TrajectoryFormat.JSON, TrajectoryFormat.TUM):
                first, whole, size = min(asyncio.run(answer(path, kind, part)) for _ in range(5))
                print(f"| {name} | {kind} | {first:.1f} | {whole:.0f} | {size / 1e6:.1f} |")


if __name__ == "__main__":
    main()
