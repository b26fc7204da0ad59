"""Measure the service on this machine: how late a pose is after its light, while recording and mapping.

    .venv/bin/python evaluation/measure_service.py RECORDING.dat [--pace 1] [--seconds 5]

The recording is replayed at `--pace` times its rate as a camera that does not wait (1 is 20 kHz for most). A frame's
light ends when it is committed to the ring, which this program watches every half millisecond; its pose counts as told
when the WebSocket message has come here. A recording that is shorter than `--seconds` is repeated: let it end where it
begins, or the tracker meets jumps.
"""

import argparse
import json
import math
import platform
import re
import subprocess
import sys
import tempfile
import threading
import time
from bisect import bisect_left
from pathlib import Path

import httpx
import numpy as np
from websockets.sync.client import connect

from spiked.recording import open_recording
from spiked.ring import Ring, RingError

_START_S = 20.0
_LOOK_S = 0.0005


class Watch(threading.Thread):
    """When each frame came into the ring."""

    def __init__(self, name: str) -> None:
        super().__init__(daemon=True)
        self._ring = Ring.attach(name)
        self._over = threading.Event()
        self.next_frames: list[int] = []
        self.at_s: list[float] = []
        self.status = self._ring.status()

    def run(self) -> None:
        while not self._over.wait(_LOOK_S):
            self.status = self._ring.status()
            if not self.next_frames or self.status.writer.next_frame > self.next_frames[-1]:
                self.next_frames.append(self.status.writer.next_frame)
                self.at_s.append(time.monotonic())

    def end(self) -> None:
        self._over.set()
        self.join()

    def came_s(self, frame: int) -> float | None:
        """The first time at which the frame was seen there."""
        place = bisect_left(self.next_frames, frame + 1)
        return self.at_s[place] if place < len(self.at_s) else None


def ring_name(capture_id: str) -> str:
    """The ring of a capture, as soon as it is there."""
    deadline = time.monotonic() + _START_S
    while time.monotonic() < deadline:
        for path in Path("/dev/shm").glob("spiked-*"):
            try:
                Ring.attach(path.name)
            except RingError:
                continue
            return path.name
        time.sleep(0.001)
    raise SystemExit(f"capture {capture_id} has opened no ring")


def measure(recording: Path, pace: float, seconds: float, steps: int) -> str:
    """A row of the table."""
    with tempfile.TemporaryDirectory() as scratch:
        command = [sys.executable, "-m", "spiked_service", "serve", "--port", "0", "--data", f"{scratch}/data"]
        command += ["--runtime", f"{scratch}/run", "--set", f"source_folders={recording.parent}"]
        daemon = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        try:
            assert daemon.stdout is not None
            found = re.search(r"http://\S+", daemon.stdout.readline())
            assert found, "the daemon said no address"
            address = found[0].rstrip("/")
            stream = f"{address.replace('http', 'ws')}/api/v1/events?topics=pose,capture,job"
            with connect(stream, compression=None, max_queue=None) as events:
                sensor, frames = (whole := open_recording(recording)).sensor, whole.frames
                repeat = math.ceil(seconds * sensor.frame_rate_hz / frames)
                source = f"replay:{recording}?pace={pace:g}&repeat={repeat}"
                body = {"source": source, "seconds": seconds, "options": {"steps": steps}}
                started = httpx.post(f"{address}/api/v1/captures", json=body, timeout=60)
                started.raise_for_status()
                watch = Watch(ring_name(started.json()["id"]))
                watch.start()
                poses, capture, job = follow(events)
                watch.end()
        finally:
            daemon.terminate()
            daemon.wait()
    return row(recording, pace, watch, poses, capture, job)


def follow(events: object) -> tuple[list[tuple[int, float]], dict, dict]:
    """Every pose with the time it came, until nothing more is tracked; the last word on capture and job."""
    poses: list[tuple[int, float]] = []
    capture: dict = {}
    job: dict = {}
    for text in events:  # type: ignore[attr-defined]
        now_s = time.monotonic()
        message = json.loads(text)
        match message["topic"]:
            case "pose":
                poses.append((message["data"]["frame"], now_s))
            case "capture":
                capture = message["data"]
            case "job":
                job = message["data"]
                # One that was outpaced begins again from the recording, and is live no more.
                ended = job["state"] in ("complete", "failed", "cancelled") or job["stage"] == "refining"
                if ended or not job["live"]:
                    break
            case "lost":
                raise SystemExit(f"this program was too slow: {message['data']}")
    return poses, capture, job


def row(recording: Path, pace: float, watch: Watch, poses: list[tuple[int, float]], capture: dict, job: dict) -> str:
    """Latencies in milliseconds; a repeated block counts once, when it was told first."""
    first: dict[int, float] = {}
    for frame, at_s in poses:
        first.setdefault(frame, at_s)
    tracking_s = min(first.values(), default=np.inf)  # poses of the bootstrap's frames come all at once, later
    came = {frame: watch.came_s(frame) for frame in first}
    delays = {frame: (light, at_s - light) for frame, at_s in first.items() if (light := came[frame]) is not None}
    if not delays:
        raise SystemExit(f"there was no pose: {job.get('reason') or job}")
    late = [delay for light, delay in delays.values() if light > tracking_s]
    which = "tracked live" if late else "all: the recording ended before the bootstrap was done"
    late = late or [delay for _, delay in delays.values()]
    ms = 1000 * np.array(late)
    sensor = open_recording(recording).sensor
    begin = bisect_left(watch.next_frames, 1)  # the source waits for its consumers before its first frame
    rate = (watch.next_frames[-1] - watch.next_frames[begin]) / (watch.at_s[-1] - watch.at_s[begin])
    lost = {reader.consumer: reader.lost for reader in watch.status.readers if reader.consumer != "preview"}
    figures = f"{np.median(ms):.0f} | {np.percentile(ms, 99):.0f} | {ms.min():.0f}"
    return (
        f"| {sensor.width}x{sensor.height} | {rate:.0f} | {len(ms)} ({which}) | {figures} | "
        f"{sum(watch.status.writer.lost.values())} | {', '.join(f'{k} {v}' for k, v in lost.items()) or '0'} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--pace", type=float, action="append")
    parser.add_argument("--seconds", type=float, default=5.0, help="of the camera's own time")
    parser.add_argument("--steps", type=int, default=200)
    given = parser.parse_args()
    recording = given.recording.resolve()
    print(f"{platform.processor() or platform.machine()}, Python {platform.python_version()}")
    print("| size | frames/s | poses | median ms | 99 % ms | least ms | lost before the ring | lost by consumers |")
    print("|---|---|---|---|---|---|---|---|")
    for pace in given.pace or [1.0]:
        print(measure(recording, pace, given.seconds, given.steps), flush=True)


if __name__ == "__main__":
    main()
