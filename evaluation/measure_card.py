"""What this machine sustains of a 1000x1000 camera behind a capture card: recorded, previewed, tracked and lost frames.

    .venv/bin/python evaluation/measure_card.py RECORDING.dat [--rates 1000 2000 5000 10000 20000] [--seconds 5]

The virtual card of tests (`tests/virtual_card.py`) writes the frames of RECORDING, to and fro, into a pipe at each
rate; a daemon captures from it as `pcie:PIPE`. What the pipe has no room for is lost in the card, as in a real one,
and the stream has no numbers that would show it: `card` counts those. A row has frames a second that the card sent,
that were received, recorded (`--data`: where), and used by the preview and the tracker; then those that were lost
in the card and after it. The share of memcpy is that of the bytes received, at 128,000 a frame.
"""

import argparse
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from spiked.recording import open_recording

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests"))
from virtual_card import virtual_card

FRAME_BYTES = 128_000
COPIED_BYTES = 1 << 28
PATIENCE_S = 120.0


def memcpy_bytes_a_second() -> float:
    """The best of five copies on one core."""
    source, target = np.ones(COPIED_BYTES, np.uint8), np.empty(COPIED_BYTES, np.uint8)
    times = []
    for _ in range(5):
        begin = time.perf_counter()
        np.copyto(target, source)
        times.append(time.perf_counter() - begin)
    return COPIED_BYTES / min(times)


@contextmanager
def serving(folder: Path, device: str) -> Iterator[str]:
    """The address of a daemon of its own, with its data in the folder."""
    command = [sys.executable, "-m", "spiked_service", "serve", "--port", "0", "--data", f"{folder}/data"]
    command += ["--runtime", f"{folder}/run", "--device", device, "--no-capture"]
    daemon = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    try:
        assert daemon.stdout is not None
        found = re.search(r"http://\S+", daemon.stdout.readline())
        assert found, "the daemon said no address"
        yield found[0].rstrip("/")
    finally:
        daemon.terminate()
        daemon.wait()


def capture(http: httpx.Client, source: str, seconds: float, track: bool) -> dict[str, Any]:
    """A capture of so many seconds of the clock, as it was told at its end."""
    body = {"source": source, "reconstruct": track, "options": {"steps": 1}}
    answer = http.post("captures", json=body)
    answer.raise_for_status()
    found: dict[str, Any] = answer.json()
    address = f"captures/{found['id']}"
    deadline = time.monotonic() + PATIENCE_S
    while not (found["counters"] or {}).get("received") and time.monotonic() < deadline:
        time.sleep(0.01)
        found = http.get(address).json()
    begin = time.monotonic()
    time.sleep(seconds)
    found = http.get(address).json()
    taken_s = time.monotonic() - begin
    http.post(f"{address}:stop")
    over = found
    while over["state"] not in ("complete", "failed") and time.monotonic() < deadline:
        time.sleep(0.1)
        over = http.get(address).json()
    for job in over["reconstruction_ids"]:
        http.post(f"reconstructions/{job}:cancel")
    return {**over, "while_running": found["counters"], "seconds": taken_s}


def row(rate: float, over: dict[str, Any], card: int, memcpy: float) -> str:
    """A line of the table."""
    running, seconds = over["while_running"], over["seconds"]
    consumers = {one["name"]: one for one in running["consumers"]}
    recorded, lost = over["recording"] or {}, over["counters"]["lost"]
    received = over["counters"]["received"]
    a_second = running["received"] / seconds

    def used(name: str) -> str:
        one = next((consumer for key, consumer in consumers.items() if name in key), None)
        return "-" if one is None else f"{one['frames_read'] / seconds:,.0f}"

    share = a_second * FRAME_BYTES / memcpy
    stored = recorded.get("frames", 0) / max(received, 1)
    causes = ", ".join(
        f"{cause} {count:,}" for cause, count in (recorded.get("lost_by_cause") or lost).items() if count
    )
    return (
        f"| {rate:,.0f} | {a_second:,.0f} | {100 * stored:.1f} % | {used('preview')} | {used('reconstruct')} "
        f"| {card:,} | {causes or '0'} | {share:.2f} |"
    )


def measure(frames: Path, data: Path, rate: float, seconds: float, track: bool, memcpy: float) -> str:
    """One capture of a daemon of its own."""
    with tempfile.TemporaryDirectory(dir=data) as folder:
        pipe = Path(folder) / "card"
        os.mkfifo(pipe)
        source = f"pcie:{pipe}?rate={rate:g}&mosaic=BGGR&flipped=true&fov=60"
        repeat = int(4 * (seconds + 30) * rate / (frames.stat().st_size // 125_000)) + 1
        with (
            serving(Path(folder), source) as address,
            httpx.Client(base_url=f"{address}/api/v1/", timeout=60) as http,
            virtual_card(frames, pipe, rate=rate, repeat=repeat, drop=True) as card,
        ):
            over = capture(http, source, seconds, track)
            card.wait(timeout=30)  # its pipe has no reader any more
            assert card.stdout is not None
            dropped = int((card.stdout.read().split() or ["0"])[-1])
    return row(rate, over, dropped, memcpy)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--rates", type=float, nargs="+", default=[1000, 2000, 5000, 10_000, 20_000])
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--data", type=Path, default=Path("/dev/shm"), help="where it is recorded")
    parser.add_argument("--no-tracking", action="store_true", help="record and preview only")
    given = parser.parse_args()
    whole, memcpy = open_recording(given.recording), memcpy_bytes_a_second()
    print(f"memcpy: {memcpy / 1e9:.1f} GB/s, {memcpy / FRAME_BYTES:,.0f} frames a second\n")
    print("| sent | received | recorded | preview | tracker | lost in the card | lost after it | share of memcpy |")
    print("|---|---|---|---|---|---|---|---|", flush=True)
    with tempfile.TemporaryDirectory(dir="/dev/shm") as folder:
        frames = Path(folder) / "frames"
        compact = whole.compact(0, whole.frames)
        np.concatenate([compact, compact[::-1]]).tofile(frames)
        for rate in given.rates:
            line = measure(frames, given.data, rate, given.seconds, not given.no_tracking, memcpy)
            print(line, flush=True)


if __name__ == "__main__":
    main()
