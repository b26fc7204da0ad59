"""Many clients for long: no frame is lost, memory stays, and everybody gets every message."""

import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psutil
import pytest
from waiting import until

CLIENTS = Path(__file__).with_name("clients.py")
EVENT_CLIENTS, VIEW_CLIENTS = 50, 8
VIEW_PERIOD_S = 0.5
RATE_HZ = 20_000
WIDTH, HEIGHT = 96, 64
START_S = 240.0
FLAT_BYTES = 3 << 20
"""What is left of growth when the events to be remembered are full, which takes about three minutes."""
FILLING_BYTES = 10 << 20
"""Before that, they and malloc's heaps still fill."""


class Memory:
    """Resident memory of the service and of the workers that should not grow, once a second."""

    def __init__(self, daemon: Any) -> None:
        self._daemon = daemon
        self.bytes: dict[str, list[int]] = {}
        self.files: list[int] = []

    def look(self) -> None:
        processes = {"service": psutil.Process(self._daemon.process.pid), **self._daemon.workers()}
        self.files.append(processes["service"].num_fds())
        for role in ("service", "acquisition", "recorder", "preview"):
            if role in processes:
                usage = processes[role].memory_info()
                self.bytes.setdefault(role, []).append(usage.rss - usage.shared)  # the ring is shared

    def thirds(self) -> dict[str, list[int]]:
        """Medians of the three thirds of the time."""
        return {role: [int(statistics.median(part)) for part in _split(seen)] for role, seen in self.bytes.items()}

    def growth(self) -> dict[str, int]:
        """From the middle third to the last."""
        return {role: last - middle for role, (_, middle, last) in self.thirds().items()}


def _split(seen: list[int]) -> list[list[int]]:
    third = len(seen) // 3
    return [seen[:third], seen[third:-third], seen[-third:]]


@contextmanager
def clients(*arguments: str) -> Iterator[Callable[[], list[dict[str, Any]]]]:
    """Clients at work, and how to end them and have their reports."""
    process = subprocess.Popen([sys.executable, str(CLIENTS), *arguments], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"

    def reports() -> list[dict[str, Any]]:
        process.terminate()
        assert process.stdout is not None
        return list(json.loads(process.stdout.readline()))

    try:
        yield reports
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


def recorded(folder: Path, width: int, height: int) -> Path:
    """1,280 frames of a simulated camera."""
    command = [sys.executable, "-m", "spiked_service", "simulate", "-o", str(folder), "--frames", "1280"]
    command += ["--motion", "arc", "--width", str(width), "--height", str(height)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return folder / "simulated.dat"


def a_scene(daemon: Any, recording: Path) -> str:
    """A reconstruction that views can be rendered from."""
    body = {"source": f"replay:{recording}", "record": False, "options": {"steps": 20}}
    capture = daemon.http.post("captures", json=body).json()["id"]

    def done() -> Any:
        jobs = daemon.http.get("reconstructions", params={"capture_id": capture}).json()["items"]
        return jobs and jobs[0]["state"] in ("complete", "failed") and jobs[0]

    job = until(done, "there is a scene")
    assert job["state"] == "complete" and job["version"] > 0, job
    return str(job["id"])


def soak(
    daemon: Any,
    tmp_path: Path,
    seconds: float,
    may_grow: int,
    size: tuple[int, int] = (WIDTH, HEIGHT),
    pace: float = 1.0,
) -> None:
    rate_hz = pace * RATE_HZ
    recording = recorded(tmp_path / "camera", *size)
    scene = a_scene(daemon, recorded(tmp_path / "room", 400, 250))
    repeats = int(seconds * rate_hz / 1280) + 1
    address = daemon.address.rstrip("/")
    with (
        clients("events", address, str(EVENT_CLIENTS)) as listeners,
        clients("views", address, str(VIEW_CLIENTS), scene, str(VIEW_PERIOD_S)) as viewers,
    ):
        source = f"replay:{recording}?pace={pace}&repeat={repeats}"
        started = daemon.http.post("captures", json={"source": source, "options": {"steps": 20}})
        assert started.status_code == 201, started.text
        capture = f"captures/{started.json()['id']}"
        until(lambda: "recorder" in daemon.workers(), "the recorder runs")
        memory = Memory(daemon)
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            memory.look()
            time.sleep(1)
        daemon.http.post(f"{capture}:stop")
        daemon.http.post(f"{capture}:stop")
        final = until(lambda: (now := daemon.http.get(capture).json())["recording"] and now, "it is recorded")
        views, events = viewers(), listeners()

    counters = final["counters"]
    assert counters["received"] + sum(counters["lost"].values()) == counters["next_frame"]
    assert sum(counters["lost"].values()) == 0
    assert final["recording"]["frames"] == counters["next_frame"]
    assert counters["next_frame"] > 0.3 * seconds * rate_hz  # a busy machine simulates more slowly, and loses nothing
    assert final["verdict"]["grade"] == "good", final["verdict"]

    assert all(client["disorder"] == 0 and "closed" not in client for client in events)
    assert all(set(client["lost"]) <= {"preview"} for client in events)
    for topic in set().union(*(client["messages"] for client in events)) - {"preview"}:
        counts = [client["messages"][topic] for client in events]
        assert max(counts) - min(counts) <= 0.02 * max(counts) + 20, (topic, counts)  # they ended one after another

    ms = sorted(took for client in views for took in client["ms"])
    status = {code: sum(client["status"].get(code, 0) for client in views) for code in ("200", "503")}
    assert status["200"] + status["503"] == len(ms) and status["200"] > 0.5 * len(ms), status
    report = {
        "seconds": seconds,
        "frames": counters["next_frame"],
        "messages": sum(sum(client["messages"].values()) for client in events),
        "views": len(ms),
        "view_ms_median": statistics.median(ms),
        "growth_mib": {role: round(grown / 2**20, 1) for role, grown in memory.growth().items()},
        "memory_mib": {role: [round(one / 2**20, 1) for one in thirds] for role, thirds in memory.thirds().items()},
        "files": (memory.files[0], memory.files[-1]),
    }
    print(json.dumps(report))
    assert all(grown < may_grow for grown in memory.growth().values()), report
    assert memory.files[-1] <= memory.files[0] + 20, report


def test_many_clients_for_a_minute(daemon: Callable[..., Any], tmp_path: Path) -> None:
    soak(daemon(), tmp_path, 60, FILLING_BYTES)


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_many_clients_for_ten_minutes(daemon: Callable[..., Any], tmp_path: Path) -> None:
    if os.statvfs(tmp_path).f_bavail * os.statvfs(tmp_path).f_frsize < 20 << 30:
        pytest.skip("needs 20 GiB for the recording")
    soak(daemon(), tmp_path, 600, FLAT_BYTES)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_camera_of_full_size_for_ten_minutes(daemon: Callable[..., Any], tmp_path: Path) -> None:
    if os.statvfs(tmp_path).f_bavail * os.statvfs(tmp_path).f_frsize < 20 << 30:
        pytest.skip("needs 20 GiB for the recording")
    soak(daemon(), tmp_path, 600, FLAT_BYTES, size=(400, 250), pace=0.1)
