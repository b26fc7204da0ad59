"""Measure the service with a long queue: every request that the page makes, and how soon the first job begins.

    .venv/bin/python evaluation/measure_queue.py [--jobs 100000] [--captures 1000] [--rounds 20]

A catalogue of a new data folder is filled with waiting reconstructions. They are spread over the captures, whose small
recording is one file with many names, and all but the first one are held until the requests have been timed.
"""

import argparse
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import httpx
import psutil
from spiked_service.base.ids import new_id
from spiked_service.settings.reconstruction_options import ReconstructionOptions
from spiked_service.store.catalogue import Catalogue
from spiked_service.store.folder import DataFolder
from spiked_service.store.rows import CaptureRow, CaptureState, JobState, Origin, Plan, ReconstructionRow, Recorded

from spiked.recording import open_recording
from spiked.sensor import Sensor
from spiked.simulate import SimulatedCamera
from spiked.simulate.record import simulate

FRAMES = 256


def fill(data: Path, jobs: int, captures: int) -> tuple[list[str], str]:
    """Write the catalogue; ids of the captures, and of the job that is not held."""
    made = simulate(SimulatedCamera(Sensor(64, 48, 20_000.0), seed=1), data.parent / "made", "one", FRAMES, views=0)
    sensor = open_recording(made).sensor
    folder = DataFolder(data)
    catalogue = Catalogue(folder.catalogue, folder)
    began = datetime.now(UTC) - timedelta(days=1)
    ids = [new_id() for _ in range(captures)]
    with catalogue.transaction():
        for number, capture_id in enumerate(ids):
            path = folder.recording(capture_id)
            path.parent.mkdir(parents=True)
            for part in made.parent.glob("one.*"):
                path.with_suffix(part.suffix).hardlink_to(part)
            row = CaptureRow(capture_id, Origin.LIVE, Plan("sim:"), CaptureState.COMPLETE, began, f"take {number}")
            recorded = Recorded(FRAMES, FRAMES * sensor.frame_bytes)
            catalogue.captures.put(replace(row, sensor=sensor, recording=recorded, ended_at=began))
        options = ReconstructionOptions(steps=20)
        job_ids = [new_id() for _ in range(jobs)]
        for number, job_id in enumerate(job_ids):
            catalogue.reconstructions.put(
                ReconstructionRow(
                    job_id,
                    ids[number % captures],
                    False,
                    JobState.QUEUED,
                    began,
                    options,
                    number % 3,
                    held=number != 2,
                )
            )
    catalogue.close()
    folder.close()
    return ids, job_ids[2]


def timed(rounds: int, ask: Callable[[], httpx.Response]) -> str:
    """Median and worst of so many requests, in milliseconds."""
    took = []
    for _ in range(rounds):
        before = time.perf_counter()
        answer = ask()
        took.append(1000 * (time.perf_counter() - before))
        answer.raise_for_status()
    return f"{statistics.median(took):.0f} | {max(took):.0f} |"


def ask_all(http: httpx.Client, captures: list[str], rounds: int) -> None:
    """Print a row of the table for each request."""
    queue = http.get("reconstructions", params={"in_turn": True, "limit": 100}).json()
    front = queue["items"][0]["id"]
    last = http.get("reconstructions", params={"state": "queued", "limit": 1}).json()["items"][0]["id"]
    gets = [
        ("captures", {"limit": 20}),
        ("captures", {"limit": 100}),
        ("captures", {"limit": 100, "sort": "reconstruction"}),
        (f"captures/{captures[0]}", {}),
        ("reconstructions", {"in_turn": True, "limit": 100}),
        ("reconstructions", {"in_turn": True, "limit": 100, "cursor": queue["next_cursor"]}),
        ("reconstructions", {"state": "queued", "limit": 100}),
        ("reconstructions", {"state": "running", "limit": 100}),
        ("reconstructions", {"state": "complete", "limit": 200}),
        ("reconstructions", {"capture_id": captures[0], "limit": 100}),
        (f"reconstructions/{front}", {}),
        (f"reconstructions/{last}", {}),
        ("devices", {}),
        ("system", {}),
    ]
    print("| request | median, ms | worst |\n|---|---|---|")
    for path, params in gets:
        name = path.replace(front, "FIRST").replace(last, "LAST").replace(captures[0], "ID")
        asked = {key: value for key, value in params.items() if key != "cursor"} | (
            {"cursor": "…"} if "cursor" in params else {}
        )
        print(
            f"| GET {httpx.URL(name, params=asked)} | {timed(rounds, lambda p=path, q=params: http.get(p, params=q))}"
        )
    metrics = str(http.base_url).replace("api/v1/", "metrics")
    print(f"| GET metrics | {timed(rounds, lambda: http.get(metrics))}")
    places = iter(range(1, 10**6))
    for name, ask in (
        ("PATCH reconstructions/FIRST, a name", lambda: http.patch(f"reconstructions/{front}", json={"name": "x"})),
        (
            "PATCH reconstructions/LAST, to any place",
            lambda: http.patch(f"reconstructions/{last}", json={"queue_place": 1 + 4999 * next(places) % 100_000}),
        ),
        (
            "PATCH reconstructions/LAST, to the front",
            lambda: http.patch(f"reconstructions/{last}", json={"queue_place": next(places) % 50 + 1}),
        ),
        ("POST reconstructions", lambda: http.post("reconstructions", json={"capture_id": captures[0]})),
    ):
        print(f"| {name} | {timed(rounds, ask)}")
    waiting = http.get("reconstructions", params={"state": "queued", "limit": rounds}).json()["items"]
    some = iter([one["id"] for one in waiting])
    took = timed(rounds, lambda: http.post(f"reconstructions/{next(some)}:cancel"))
    print(f"| POST reconstructions/ID:cancel | {took}")


def main() -> None:
    """Fill, start, ask."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--jobs", type=int, default=100_000)
    parser.add_argument("--captures", type=int, default=1000)
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--serve", action="store_true", help="leave the service running until Enter is pressed")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        data = Path(scratch) / "data"
        captures, first = fill(data, given.jobs, given.captures)
        begun = time.monotonic()
        command = [sys.executable, "-m", "spiked_service", "serve", "--port", "0", "--no-capture", "--data", f"{data}"]
        daemon = subprocess.Popen([*command, "--runtime", f"{scratch}/run"], stdout=subprocess.PIPE, text=True)
        try:
            assert daemon.stdout is not None
            found = re.search(r"http://\S+", daemon.stdout.readline())
            assert found, "the daemon said no address"
            serves = time.monotonic()
            print(f"address after {serves - begun:.1f} s")
            with httpx.Client(base_url=f"{found[0]}api/v1/", timeout=300) as http:
                while (job := http.get(f"reconstructions/{first}").json())["started_at"] is None:
                    if time.monotonic() > serves + 120:
                        raise SystemExit(f"the first job has not begun after two minutes: {job}")
                    time.sleep(0.02)
                first_s = datetime.fromisoformat(job["started_at"]).timestamp() - (
                    time.time() - time.monotonic() + serves
                )
                print(f"first job {first_s:.1f} s after the address")
                ask_all(http, captures, given.rounds)
            print(f"memory {psutil.Process(daemon.pid).memory_info().rss / 1e9:.2f} GB")
            if given.serve:
                input(f"{found[0]} until Enter ")
        finally:
            daemon.terminate()
            daemon.wait()


if __name__ == "__main__":
    main()
