"""Measure a live capture of a minute: what is lost, how good the path is when it stops, and what memory it takes.

    .venv/bin/python evaluation/measure_live.py RECORDING.dat --truth groundtruth.tum [--seconds 60] [--page]

The recording is replayed at its own rate as a camera that does not wait, recorded, and reconstructed. Once a second the
memory of every process is read: what is resident, without the ring, which they share. `--page` opens the scene page in
Chromium and measures the time between its pictures and what it fetches. Scored are the version that is the newest when
the capture stops, with the poses of views alone, and the last one before all frames are gone through once more.
"""

import argparse
import json
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import contextmanager, suppress
from pathlib import Path

import httpx
import numpy as np
import psutil

from spiked.evaluate import score_trajectory
from spiked.pose import rotation_of
from spiked.recording import open_recording
from spiked.trajectory import Trajectory

FLAT_S = 40.0
"""Memory is to be flat over the last so many seconds of the capture."""
FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
SAMPLED_POSES = 100_000
"""Poses that the path is scored with."""
CADENCE = """() => {
    window.pictures = [];
    let before = performance.now();
    const next = (now) => { window.pictures.push(now - before); before = now; requestAnimationFrame(next); };
    requestAnimationFrame(next);
}"""


class Memory(threading.Thread):
    """Resident bytes of the service and its workers, without what is shared, once a second."""

    def __init__(self, service: int) -> None:
        super().__init__(daemon=True)
        self._service = psutil.Process(service)
        self._over = threading.Event()
        self._begun_s = time.monotonic()
        self.bytes: dict[str, list[tuple[float, int]]] = {}

    def run(self) -> None:
        while not self._over.wait(1.0):
            processes = [("service", self._service)]
            for child in self._service.children():
                with suppress(psutil.NoSuchProcess):
                    words = child.cmdline()
                    if "spiked_service.workers" in words[1:-1]:
                        processes.append((f"{words[-1]} {child.pid}", child))
            for name, process in processes:
                with suppress(psutil.NoSuchProcess):
                    usage = process.memory_info()
                    seen = self.bytes.setdefault(name, [])
                    seen.append((time.monotonic() - self._begun_s, usage.rss - usage.shared))

    def end(self) -> None:
        self._over.set()
        self.join()


@contextmanager
def service(folder: Path, recording: Path):
    command = [sys.executable, "-m", "spiked_service", "serve", "--port", "0", "--no-capture"]
    command += ["--data", str(folder / "data"), "--runtime", str(folder / "run")]
    daemon = subprocess.Popen(
        [*command, "--set", f"source_folders={recording.parent.resolve()}"], stdout=subprocess.PIPE, text=True
    )
    try:
        assert daemon.stdout is not None
        found = re.search(r"http://\S+", daemon.stdout.readline())
        assert found, "the daemon said no address"
        yield daemon.pid, found[0].rstrip("/")
    finally:
        daemon.terminate()
        daemon.wait()


def path_now(http: httpx.Client, job: str, poses: int) -> tuple[int, Trajectory]:
    """The newest version's number and path, thinned."""
    step = max(1, poses // SAMPLED_POSES)
    told = http.get(f"reconstructions/{job}/trajectory", params={"step": step}).raise_for_status().json()
    rotations = rotation_of(np.array(told["quaternions_wxyz"]))
    return told["version"], Trajectory(np.array(told["times_s"]), rotations, np.array(told["positions"]))


@contextmanager
def page_open(address: str, capture_id: str, wanted: bool):
    """The scene page in a browser; yields what tells of it at the end."""
    if not wanted:
        yield lambda: {}
        return
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS)
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        fetched: dict[str, list[int]] = {}

        def on_finished(request) -> None:
            kind = request.url.split("?")[0].rsplit("/", 1)[-1]
            if "/api/" in request.url:
                fetched.setdefault(kind, []).append(int(request.sizes()["responseBodySize"]))

        page.on("requestfinished", on_finished)
        page.goto(f"{address}/?page=scene&capture={capture_id}")
        page.evaluate(CADENCE)

        def told() -> dict:
            pictures = page.evaluate("() => window.pictures")
            return {
                "pictures_ms": {f"{share}%": round(float(np.percentile(pictures, share)), 1) for share in (50, 95, 99)},
                "splats_shown": page.locator(".stage canvas").get_attribute("data-splats"),
                "version_shown": page.locator(".stage canvas").get_attribute("data-version"),
                "fetched_kB": {kind: [len(sizes), round(sum(sizes) / 1e3)] for kind, sizes in fetched.items()},
                "changes_kB": [round(size / 1e3) for size in fetched.get("changes", [])],
                "waited": page.wait_for_timeout,
            }

        yield told
        browser.close()


def measure(recording: Path, truth: Path | None, seconds: float, steps: int, with_page: bool, folder: Path) -> dict:
    whole = open_recording(recording)
    frames = min(int(seconds * whole.sensor.frame_rate_hz), whole.frames)
    with service(folder, recording) as (pid, address), httpx.Client(base_url=f"{address}/api/v1/", timeout=120) as http:
        body = {"source": f"replay:{recording.resolve()}?pace=1", "frames": frames, "options": {"steps": steps}}
        capture_id = http.post("captures", json=body).raise_for_status().json()["id"]
        memory = Memory(pid)
        memory.start()
        begun_s = time.monotonic()
        with page_open(address, capture_id, with_page) as told:
            page = told()
            while True:
                page.get("waited", lambda ms: time.sleep(ms / 1e3))(500)
                capture = http.get(f"captures/{capture_id}").json()
                if capture["state"] not in ("starting", "waiting", "streaming"):
                    break
            stopped_s = time.monotonic() - begun_s
            job = http.get("reconstructions", params={"capture_id": capture_id}).json()["items"][0]
            path = path_now(http, job["id"], job["poses"])[1]
            at_stop = scored(path, truth, frames, whole.sensor.frame_rate_hz)
            timeline = http.get(f"reconstructions/{job['id']}/timeline", params={"points": 10_000}).json()
            while (job := http.get(f"reconstructions/{job['id']}").json())["live"] and job["state"] == "running":
                time.sleep(0.1)
            adjusted_s = time.monotonic() - begun_s - stopped_s
            version, path = path_now(http, job["id"], job["poses"])
            page = told()
            page.pop("waited", None)
        while capture["recording"] is None and capture["state"] not in ("complete", "failed"):
            time.sleep(0.5)
            capture = http.get(f"captures/{capture_id}").json()
        versions = http.get(f"reconstructions/{job['id']}/versions").json()["items"]
        memory.end()
    flat_from_s = stopped_s - min(FLAT_S, 2 / 3 * stopped_s)
    recorded = capture["recording"] or {}
    return {
        "frames": frames,
        "seconds_taken": round(stopped_s, 1),
        "capture": {name: capture[name] for name in ("state", "reason", "counters")},
        "recording": {name: recorded.get(name) for name in ("frames", "lost", "lost_by_cause")},
        "at_stop": {
            "score": at_stop,
            "closures": len(timeline["closures"]),
            "states": {state: timeline["state"].count(state) for state in set(timeline["state"])},
        },
        "last_live_version": {
            "after_stop_s": round(adjusted_s, 1),
            "version": version,
            "poses_of_version": versions[-1]["poses"] if versions else 0,
            "path_to_s": float(path.times_s[-1]),
            "state": job["tracking_state"],
            "reason": job["reason"],
            "splats": job["splats"],
            "score": scored(path, truth, frames, whole.sensor.frame_rate_hz),
        },
        "page": page,
        "memory_MB": {name: flat(seen, flat_from_s, stopped_s) for name, seen in memory.bytes.items()},
    }


def scored(path: Trajectory, truth: Path | None, frames: int, rate_hz: float) -> dict[str, float | None] | None:
    """ATE, and the share of the frames that have a pose."""
    if truth is None:
        return None
    known = Trajectory.read_tum(truth)
    step = max(1, frames // SAMPLED_POSES)
    some = np.flatnonzero(known.times_s < frames / rate_hz)[step // 2 :: step]
    known = Trajectory(known.times_s[some], known.rotations[some], known.centres[some])
    rows = path.nearest(known.times_s, step / rate_hz)
    score = score_trajectory(truth=known, estimate=path, frame_rate_hz=rate_hz / (2 * step))
    return {"ate_percent": score.errors and score.errors.ate_percent, "near": float((rows >= 0).mean())}


def flat(seen: list[tuple[float, int]], from_s: float, to_s: float) -> dict[str, float]:
    """Medians of the first and the last quarter of the time, and the most of all of it, MB."""
    part = [size / 1e6 for at_s, size in seen if from_s <= at_s <= to_s]
    if len(part) < 4:
        return {}
    quarter = max(1, len(part) // 4)
    first, last = statistics.median(part[:quarter]), statistics.median(part[-quarter:])
    return {"first": round(first, 1), "last": round(last, 1), "most": round(max(size for _, size in seen) / 1e6, 1)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--truth", type=Path, help="TUM file with the camera's path")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--steps", type=int, default=0, help="of refinement after the capture")
    parser.add_argument("--page", action="store_true", help="with the scene page open in Chromium")
    parser.add_argument("--folder", type=Path, default=Path(), help="where it is recorded, 250 MB a second")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=given.folder) as folder:
        found = measure(given.recording, given.truth, given.seconds, given.steps, given.page, Path(folder))
    print(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
