"""`spiked reconstruct --watch`: the page of an offline reconstruction, served while it works."""

import subprocess
import sys
import time
from pathlib import Path

import httpx
import numpy as np
import pytest

from spiked.recording import RecordingWriter
from spiked.sensor import Intrinsics, Sensor
from spiked.simulate import MotionKind, SimulatedCamera

DEADLINE_S = 120.0


def spiked(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "spiked_service", *map(str, arguments)]


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated recording of 320 frames."""
    sensor = Sensor(160, 96, 20000.0, intrinsics=Intrinsics.from_fov(160, 96, 60))
    camera = SimulatedCamera(sensor, 2, MotionKind.ARC, flow_px=0.25, parallax=0.5)
    path = tmp_path_factory.mktemp("watched") / "room.dat"
    with RecordingWriter(path, sensor) as writer:
        writer.append(camera.next_frames(320))
    return path


def test_the_page_shows_stage_path_curve_and_pictures(room: Path, tmp_path: Path) -> None:
    command = spiked("reconstruct", room, "-o", tmp_path / "out", "--steps", 200_000, "--watch", "--watch-port", 0)
    with subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True) as process:
        assert process.stderr is not None
        line = next(line for line in process.stderr if "http://" in line)
        with httpx.Client(base_url=line.split()[-1], timeout=20) as http:
            assert "watch.js" in http.get("/").text
            assert http.get("/watch.js").status_code == http.get("/watch.css").status_code == 200
            assert http.get("/nothing.png").status_code == 404
            deadline = time.monotonic() + DEADLINE_S
            state: dict[str, object] = {}
            while time.monotonic() < deadline and not state.get("picture"):
                state = http.get("/state.json").json()
            assert state["stage"] == "refining" and state["frames"] == 320, state
            assert len(np.asarray(state["path"])) > 100 and len(np.asarray(state["curve"])) >= 1
            for name in ("observed", "rendered", "difference"):
                assert http.get(f"/{name}.png").content.startswith(b"\x89PNG")
        process.terminate()
        process.stderr.read()
        assert process.wait(60) == 130
    assert (tmp_path / "out" / "scene.ply").exists()


def test_a_port_in_use_is_said_before_the_work_begins(room: Path, tmp_path: Path) -> None:
    import socket

    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        command = spiked("reconstruct", room, "-o", tmp_path / "out", "--watch", "--watch-port", port)
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2 and str(port) in done.stderr and not (tmp_path / "out").exists()
