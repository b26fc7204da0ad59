"""Measure the service with many jobs: requests about jobs and captures, its start, its memory, many requests at once.

    .venv/bin/python evaluation/measure_queue.py [--jobs 100000] [--against 100] [--captures 1000] [--rounds 100]

A catalogue of a new data folder is filled by its own code: two in five jobs wait, some of them held, the others are
complete (with the files of a published scene), failed and cancelled. Half of all jobs belong to one capture, the others
to the rest; all captures share the files of one small recording. One job runs. Its process is stopped while requests
are timed, so that only the service works. Times are those of a client; CPU time is that of the service's process, which
other programs on the machine hardly change.
"""

import argparse
import os
import re
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from itertools import count
from pathlib import Path

import httpx
import numpy as np
import psutil
from spiked_service.base.ids import new_id
from spiked_service.results.versions import Publisher, version_row
from spiked_service.settings.reconstruction_options import ReconstructionOptions
from spiked_service.store.catalogue import Catalogue
from spiked_service.store.folder import DataFolder
from spiked_service.store.rows import CaptureRow, CaptureState, JobState, Origin, Plan, ReconstructionRow, Recorded

from spiked.recording import open_recording
from spiked.scene import Scene
from spiked.sensor import Intrinsics, Sensor
from spiked.simulate import SimulatedCamera
from spiked.simulate.record import simulate
from spiked.trajectory import Trajectory

FRAMES = 512
STATES = (JobState.QUEUED, JobState.COMPLETE, JobState.QUEUED, JobState.FAILED, JobState.CANCELLED)
"""Of the jobs, in turn."""
AT_ONCE = 8
"""Clients that submit and cancel at the same time."""


@dataclass(frozen=True)
class Filled:
    """Ids of what was made."""

    captures: list[str]
    """The first one has half of the jobs."""
    jobs: dict[JobState, list[str]]
    """The oldest first."""


def fill(data: Path, jobs: int, captures: int) -> Filled:
    """Write catalogue and files."""
    scratch = data.parent
    made = simulate(SimulatedCamera(Sensor(160, 100, 20_000.0), seed=1), scratch / "made", "one", FRAMES, views=0)
    sensor, began = open_recording(made).sensor, datetime.now(UTC) - timedelta(days=1)
    (scratch / "scene").mkdir()
    scene = Scene(*(np.ones(shape, np.float32) for shape in ((7, 3), (7, 4), (7, 3), (7,), (7, 1))))
    path = Trajectory(np.arange(2) / 100, np.tile(np.eye(3), (2, 1, 1)), np.zeros((2, 3)))
    published = Publisher(scratch / "scene").publish(scene, path, 1.0, 20.0, Intrinsics(140, 140, 80, 50))
    folder = DataFolder(data)
    catalogue = Catalogue(folder.catalogue, folder)
    filled = Filled([new_id() for _ in range(captures)], {state: [] for state in STATES})
    with catalogue.transaction():
        for number, capture_id in enumerate(filled.captures):
            target = folder.recording(capture_id)
            target.parent.mkdir(parents=True)
            for part in made.parent.glob("one.*"):
                target.with_suffix(part.suffix).hardlink_to(part)
            row = CaptureRow(capture_id, Origin.LIVE, Plan("sim:"), CaptureState.COMPLETE, began, f"take {number}")
            recorded = Recorded(FRAMES, FRAMES * sensor.frame_bytes)
            catalogue.captures.put(replace(row, sensor=sensor, recording=recorded, ended_at=began))
        for number in range(jobs):
            job_id, state = new_id(), STATES[number % len(STATES)]
            filled.jobs[state].append(job_id)
            capture_id = filled.captures[0 if number % 2 else number // 2 % captures]
            row = ReconstructionRow(job_id, capture_id, False, state, began, ReconstructionOptions(steps=100_000))
            if state is JobState.QUEUED:
                row = replace(row, priority=number // 5 % 3, held=number % 50 == 2)
            else:
                row = replace(row, started_at=began, ended_at=began + timedelta(minutes=1))
            if state is JobState.COMPLETE:
                shutil.copytree(scratch / "scene", folder.reconstruction(job_id), copy_function=os.link)
                row = replace(row, version=1, white=1.0, poses=2, splats=len(scene), progress=1.0)
                catalogue.put_version(version_row(job_id, published), {1})
            catalogue.reconstructions.put(row)
    catalogue.close()
    folder.close()
    return filled


@contextmanager
def served(data: Path, figures: dict[str, float]) -> Iterator[tuple[httpx.Client, psutil.Process]]:
    """The service on the data folder, whose one running job has been stopped."""
    begun = time.monotonic()
    command = [sys.executable, "-m", "spiked_service", "serve", "--port", "0", "--no-capture", "--data", f"{data}"]
    daemon = subprocess.Popen([*command, "--runtime", f"{data.parent}/run"], stdout=subprocess.PIPE, text=True)
    process = psutil.Process(daemon.pid)
    try:
        assert daemon.stdout is not None
        found = re.search(r"http://\S+", daemon.stdout.readline())
        assert found, "the daemon said no address"
        figures["start: seconds to the address"] = time.monotonic() - begun
        figures["start: CPU s"] = _cpu_s(process)
        with httpx.Client(base_url=f"{found[0]}api/v1/", timeout=300) as http:
            while not http.get("reconstructions", params={"state": "running"}).json()["items"]:
                time.sleep(0.05)
            figures["start: seconds from there to the first job"] = (
                time.monotonic() - begun - figures["start: seconds to the address"]
            )
            for worker in process.children(recursive=True):
                worker.send_signal(signal.SIGSTOP)
            while "recovery" in http.get(str(http.base_url).replace("api/v1/", "readyz")).text:
                time.sleep(0.5)  # the service looks at the files of all jobs after its start
            figures["memory after the start, MB"] = process.memory_info().rss / 1e6
            yield http, process
            figures["memory at the end, MB"] = process.memory_info().rss / 1e6
    finally:
        for worker in process.children(recursive=True):
            worker.kill()
        daemon.terminate()
        daemon.wait()


def _cpu_s(process: psutil.Process) -> float:
    used = process.cpu_times()
    return float(used.user + used.system)


@dataclass(frozen=True)
class Measured:
    """Of one request, milliseconds."""

    median: float
    high: float
    """99 of 100 are below."""
    cpu: float
    """Mean CPU time of the service's process."""


def measured(process: psutil.Process, rounds: int, ask: Callable[[], httpx.Response]) -> Measured:
    """Time a request again and again."""
    took, before = [], _cpu_s(process)
    for _ in range(rounds):
        begun = time.perf_counter()
        answer = ask()
        took.append(1000 * (time.perf_counter() - begun))
        answer.raise_for_status()
    cpu = 1000 * (_cpu_s(process) - before) / rounds
    return Measured(statistics.median(took), float(np.quantile(took, 0.99)), cpu)


def reads(http: httpx.Client, filled: Filled) -> dict[str, Callable[[], httpx.Response]]:
    """Requests that change nothing, by what is printed of them."""
    large, small, done = filled.captures[0], filled.captures[-1], filled.jobs[JobState.COMPLETE]
    queue = http.get("reconstructions", params={"in_turn": True, "limit": 100}).json()
    first, last = queue["items"][0]["id"], filled.jobs[JobState.QUEUED][-1]
    middle = filled.jobs[JobState.QUEUED][len(filled.jobs[JobState.QUEUED]) // 2]
    above = str(http.base_url).replace("api/v1/", "")
    paths: dict[str, tuple[str, dict[str, str]]] = {
        "captures?limit=100": ("captures?limit=100", {}),
        "captures?limit=100&sort=reconstruction": ("captures?limit=100&sort=reconstruction", {}),
        "captures?limit=100&q=take 7": ("captures", {"limit": "100", "q": "take 7"}),
        "captures/LARGE (half of the jobs)": (f"captures/{large}", {}),
        "captures/SMALL": (f"captures/{small}", {}),
        "captures/LARGE/trajectory": (f"captures/{large}/trajectory", {}),
        "captures/LARGE/scene": (f"captures/{large}/scene", {}),
        "reconstructions?in_turn=true&limit=100": ("reconstructions?in_turn=true&limit=100", {}),
        "the same from the middle": ("reconstructions", {"in_turn": "true", "limit": "100", "cursor": middle}),
        "reconstructions?limit=100": ("reconstructions?limit=100", {}),
        "reconstructions?state=queued&limit=100": ("reconstructions?state=queued&limit=100", {}),
        "reconstructions?state=running": ("reconstructions?state=running", {}),
        "reconstructions?state=complete&limit=200": ("reconstructions?state=complete&limit=200", {}),
        "reconstructions?capture_id=LARGE&limit=100": ("reconstructions", {"capture_id": large, "limit": "100"}),
        "the same of one state": ("reconstructions", {"capture_id": large, "limit": "100", "state": "failed"}),
        "reconstructions/FIRST of the queue": (f"reconstructions/{first}", {}),
        "reconstructions/MIDDLE": (f"reconstructions/{middle}", {}),
        "reconstructions/LAST": (f"reconstructions/{last}", {}),
        "reconstructions/COMPLETE": (f"reconstructions/{done[0]}", {}),
        "reconstructions/COMPLETE/versions": (f"reconstructions/{done[0]}/versions", {}),
        "devices": ("devices", {}),
        "system": ("system", {}),
        "doctor": ("doctor", {}),
        "metrics": (f"{above}metrics", {}),
        "readyz": (f"{above}readyz", {}),
    }
    return {
        f"GET {name}": lambda p=path, q=query: http.get(p, params=q or None) for name, (path, query) in paths.items()
    }


def writes(http: httpx.Client, filled: Filled) -> dict[str, Callable[[], httpx.Response]]:
    """Requests that change something, by what is printed of them."""
    front = http.get("reconstructions", params={"in_turn": True, "limit": 1}).json()["items"][0]["id"]
    numbers, queued = count(1), filled.jobs[JobState.QUEUED]
    last, waiting, done = queued[-1], iter(queued[len(queued) // 2 :]), iter(filled.jobs[JobState.COMPLETE])
    failed, cancelled = iter(filled.jobs[JobState.FAILED]), iter(filled.jobs[JobState.CANCELLED])
    job = {"capture_id": filled.captures[0]}

    def patch(job_id: str, **edit: object) -> httpx.Response:
        return http.patch(f"reconstructions/{job_id}", json=edit)

    def first_waiting() -> str:
        found = http.get("reconstructions", params={"in_turn": True, "limit": 1}).json()["items"][0]["id"]
        return str(found)

    def with_key() -> httpx.Response:
        return http.post("reconstructions", json=job, headers={"Idempotency-Key": new_id()})

    return {
        "PATCH reconstructions/FIRST, a name": lambda: patch(front, name=f"{next(numbers)}"),
        "PATCH reconstructions/LAST, to any place": lambda: patch(
            last, queue_place=1 + 4999 * next(numbers) % len(queued)
        ),
        "PATCH reconstructions/LAST, to the front": lambda: patch(last, queue_place=next(numbers) % 50 + 1),
        "PATCH reconstructions/LAST, held or not": lambda: patch(last, held=next(numbers) % 2 == 0),
        "POST reconstructions": lambda: http.post("reconstructions", json=job),
        "POST reconstructions, with a key": with_key,
        "POST reconstructions/ID:cancel": lambda: http.post(f"reconstructions/{next(waiting)}:cancel"),
        "the same, the first one, asked for before": lambda: http.post(f"reconstructions/{first_waiting()}:cancel"),
        "POST reconstructions/FAILED:restart": lambda: http.post(f"reconstructions/{next(failed)}:restart"),
        "DELETE reconstructions/COMPLETE": lambda: http.delete(f"reconstructions/{next(done)}"),
        "DELETE reconstructions/CANCELLED": lambda: http.delete(f"reconstructions/{next(cancelled)}"),
        "PATCH captures/LARGE, notes": lambda: http.patch(
            f"captures/{filled.captures[0]}", json={"notes": f"{next(numbers)}"}
        ),
    }


def many_at_once(http: httpx.Client, process: psutil.Process, capture_id: str, number: int) -> dict[str, Measured]:
    """Submit and cancel many jobs with several clients, asking for the state of the service meanwhile."""

    def post(path: str, body: object) -> str:
        return str(http.post(path, json=body).raise_for_status().json()["id"])

    def at_once(work: Callable[[str], str], over: list[str]) -> tuple[list[str], Measured]:
        waits, before = [], _cpu_s(process)
        with ThreadPoolExecutor(AT_ONCE) as clients:
            pending = [clients.submit(work, one) for one in over]
            while not pending[-1].done():
                begun = time.perf_counter()
                http.get(str(http.base_url).replace("api/v1/", "healthz")).raise_for_status()
                waits.append(1000 * (time.perf_counter() - begun))
                time.sleep(0.02)
            done = [one.result() for one in pending]
        cpu = 1000 * (_cpu_s(process) - before) / len(over)
        return done, Measured(statistics.median(waits), float(np.quantile(waits, 0.99)), cpu)

    made, submitted = at_once(lambda one: post("reconstructions", {"capture_id": one}), [capture_id] * number)
    _, cancelled = at_once(lambda one: post(f"reconstructions/{one}:cancel", None), made)
    return {
        f"GET healthz while {number} are submitted; CPU for each of these": submitted,
        f"GET healthz while {number} are cancelled; CPU for each of these": cancelled,
    }


def run(jobs: int, captures: int, rounds: int, *, serve: bool) -> tuple[dict[str, Measured], dict[str, float]]:
    """All requests with so many jobs, and figures of the start and the memory."""
    with tempfile.TemporaryDirectory() as scratch:
        data, figures = Path(scratch) / "data", dict[str, float]()
        filled = fill(data, jobs, captures)
        with served(data, figures) as (http, process):
            asked = {**reads(http, filled), **writes(http, filled)}
            few = min(rounds, jobs // 10)
            found = {name: measured(process, few, ask) for name, ask in asked.items()}
            found |= many_at_once(http, process, filled.captures[1], min(2000, 10 * jobs))
            for name, ask in (
                ("DELETE captures/LARGE, once", lambda: http.delete(f"captures/{filled.captures[0]}")),
                ("POST captures/LARGE:purge, once", lambda: http.post(f"captures/{filled.captures[0]}:purge")),
            ):
                found[name] = measured(process, 1, ask)
                if "purge" not in name:
                    figures[f"after {name}: seconds until the queue is still"] = _still_s(http)
            found |= while_purged(http, process, filled, few, figures)
            if serve:
                input(f"{http.base_url} until Enter ")
    return found, figures


def while_purged(
    http: httpx.Client, process: psutil.Process, filled: Filled, rounds: int, figures: dict[str, float]
) -> dict[str, Measured]:
    """Requests while a thread deletes the capture with half of the jobs, and how long that takes."""
    begun, other = time.monotonic(), {"capture_id": filled.captures[1]}
    asked: dict[str, Callable[[], httpx.Response]] = {
        "GET captures?limit=100": lambda: http.get("captures?limit=100"),
        "GET reconstructions?in_turn=true&limit=100": lambda: http.get("reconstructions?in_turn=true&limit=100"),
        "POST reconstructions": lambda: http.post("reconstructions", json=other),
    }
    found = {f"{name}, during the purge": measured(process, rounds, ask) for name, ask in asked.items()}
    figures["seconds of the purge during these requests"] = time.monotonic() - begun
    data = Path(process.cmdline()[process.cmdline().index("--data") + 1])
    while any((data / "captures").glob(".*.removed")):
        time.sleep(0.1)
    figures["seconds until all of it is deleted"] = time.monotonic() - begun
    return found


def _still_s(http: httpx.Client) -> float:
    """Seconds until the length of the queue no longer changes."""
    begun, before = time.monotonic(), None
    while (now := http.get("reconstructions?in_turn=true&limit=1").json()["total"]) != before:
        before = now
        time.sleep(0.5)
    return time.monotonic() - begun


def main() -> None:
    """Fill, start, ask; print a row for each request."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--jobs", type=int, default=100_000)
    parser.add_argument("--against", type=int, default=100, help="as many jobs, to compare with; 0: no comparison")
    parser.add_argument("--captures", type=int, default=1000)
    parser.add_argument("--rounds", type=int, default=100)
    parser.add_argument("--serve", action="store_true", help="leave the service running until Enter is pressed")
    given = parser.parse_args()
    few, before = dict[str, Measured](), dict[str, float]()
    if given.against:
        few, before = run(given.against, min(given.captures, 20), given.rounds, serve=False)
    found, figures = run(given.jobs, given.captures, given.rounds, serve=given.serve)
    print(f"| request, with {given.jobs} jobs | median, ms | 99 % | CPU, ms | CPU with {given.against} |")
    print("|---|---|---|---|---|")
    for name, one in found.items():
        cpu = f"{few[name].cpu:.1f}" if name in few else ""
        print(f"| {name} | {one.median:.1f} | {one.high:.1f} | {one.cpu:.1f} | {cpu} |")
    for name, value in figures.items():
        print(f"{name}: {value:.1f}" + (f" (with {given.against} jobs {before[name]:.1f})" if before else ""))


if __name__ == "__main__":
    main()
