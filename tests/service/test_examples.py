"""The examples of docs/events.md, run against a daemon as they stand."""

import json
import os
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from queue import Empty, Queue
from typing import Any

import pytest
from waiting import until

EXAMPLES = Path(__file__).parents[2] / "examples"
DEADLINE_S = 60.0


@contextmanager
def running(*command: str, cwd: Path | None = None) -> Iterator["Queue[str]"]:
    """A program, and the lines that it prints."""
    environment = {**os.environ, "MPLBACKEND": "Agg"}
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, cwd=cwd, start_new_session=True, env=environment
    )
    lines: Queue[str] = Queue()

    def read() -> None:
        assert process.stdout is not None
        for line in process.stdout:
            lines.put(line)

    reader = threading.Thread(target=read)
    reader.start()
    try:
        yield lines
    finally:
        os.killpg(process.pid, signal.SIGTERM)
        process.wait(DEADLINE_S)
        reader.join()


def reload_until(daemon: Any, lines: "Queue[str]") -> str:
    """Do something that is an event, until the program has printed it."""
    for _ in range(int(DEADLINE_S / 0.2)):
        daemon.http.post("/configuration:reload")
        try:
            return lines.get(timeout=0.2)
        except Empty:
            continue
    raise AssertionError("the example printed nothing")


def websocket(daemon: Any) -> str:
    return str(daemon.address).replace("http", "ws").rstrip("/")


def test_python_prints_events(daemon: Callable[..., Any]) -> None:
    one = daemon()
    with running(sys.executable, str(EXAMPLES / "events.py"), websocket(one), "log") as lines:
        seq, topic, data = reload_until(one, lines).split(maxsplit=2)
    assert int(seq) > 0 and topic == "log" and data.startswith("{")


def test_curl_prints_events(daemon: Callable[..., Any]) -> None:
    if shutil.which("curl") is None:
        pytest.skip("needs curl")
    one = daemon()
    with running(str(EXAMPLES / "events.sh"), one.address.rstrip("/"), "log") as lines:
        assert json.loads(reload_until(one, lines))["topic"] == "log"


def test_javascript_prints_events(daemon: Callable[..., Any]) -> None:
    if shutil.which("node") is None:
        pytest.skip("needs node")
    one = daemon()
    command = ["node", "--experimental-websocket", str(EXAMPLES / "events.mjs"), websocket(one), "log"]
    with running(*command) as lines:
        assert reload_until(one, lines).split()[1] == "log"


def test_the_zmq_example_prints_the_state(daemon: Callable[..., Any]) -> None:
    one = daemon("--no-capture", "--device", "sim:")
    plan = {"source": "sim:?width=64&height=48", "frames": 64, "reconstruct": False}
    assert one.http.post("captures", json=plan).status_code == 201
    until(lambda: one.http.get("captures").json()["items"][0]["state"] == "complete", "the capture is complete")
    zmq = one.http.get("system").json()["zmq"]
    assert all(zmq[name].startswith("tcp://127.0.0.1:") for name in ("events", "state", "previews"))
    ports = [zmq[name].rpartition(":")[2] for name in ("events", "state")]
    with running(sys.executable, str(EXAMPLES / "zmq_events.py"), *ports) as lines:
        printed = [lines.get(timeout=DEADLINE_S).split() for _ in range(2)]
    assert sorted(line[:2] for line in printed) == [["now:", "capture"], ["now:", "device"]]
    assert ["now:", "capture", "complete"] in printed


@pytest.mark.slow
def test_the_path_is_drawn_and_poses_come_over_zmq(daemon: Callable[..., Any], tmp_path: Path) -> None:
    command = [sys.executable, "-m", "spiked_service", "simulate", "-o", str(tmp_path / "room"), "--motion", "arc"]
    subprocess.run([*command, "--frames", "1280", "--width", "400", "--height", "250"], check=True, capture_output=True)
    one = daemon()
    zmq = one.http.get("system").json()["zmq"]
    ports = [zmq[name].rpartition(":")[2] for name in ("events", "state")]
    with (
        running(sys.executable, str(EXAMPLES / "live_trajectory.py"), websocket(one), cwd=tmp_path),
        running(sys.executable, str(EXAMPLES / "zmq_events.py"), *ports) as poses,
    ):
        until(lambda: one.http.get("system").json()["event_clients"] == 1, "the example listens")
        body = {"source": f"replay:{tmp_path / 'room' / 'simulated.dat'}", "options": {"steps": 10}}
        assert one.http.post("captures", json=body).status_code == 201
        while (line := poses.get(timeout=4 * DEADLINE_S)).startswith("now:"):  # the state as it was found
            pass
        frame, *position = line.split()
        assert int(frame) >= 0 and len(position) == 3
        until((tmp_path / "trajectory.png").is_file, "the picture is there")


@pytest.mark.slow
def test_the_bridge_writes_a_bag_that_rosbags_reads(daemon: Callable[..., Any], tmp_path: Path) -> None:
    from rosbags.highlevel import AnyReader

    one = daemon()
    command = [sys.executable, str(EXAMPLES / "ros2_bridge.py"), websocket(one), "--bag", str(tmp_path / "bag")]
    with running(*command, "--captures", "1") as lines:
        assert lines.get(timeout=DEADLINE_S) == "connected\n"
        body = {"source": "sim:?width=240&height=160&motion=arc", "frames": 1280, "options": {"steps": 10}}
        assert one.http.post("captures", json=body).status_code == 201
        until((tmp_path / "bag" / "metadata.yaml").is_file, "the bag is complete")
    job = one.http.get("reconstructions").json()["items"][0]["id"]
    found: dict[str, list[Any]] = {}
    with AnyReader([tmp_path / "bag"]) as reader:
        for connection, _, raw in reader.messages():
            found.setdefault(connection.topic, []).append(reader.deserialize(raw, connection.msgtype))
    assert {"/tf", "/pose", "/camera/image_raw"} <= set(found)
    image, pose = found["/camera/image_raw"][0], found["/pose"][-1]
    assert (image.encoding, image.width, image.height) == ("rgb8", 240, 160)  # WebP is never grey
    frames = one.http.get(f"reconstructions/{job}/trajectory?format=json").json()["frames"]
    assert len(found["/pose"]) == len(found["/tf"]) <= len(frames)
    assert pose.header.frame_id == "world" and abs(pose.pose.orientation.w) <= 1


def test_the_trajectory_example_has_twenty_lines() -> None:
    text = (EXAMPLES / "live_trajectory.py").read_text()
    code = [line for line in text.split('"""')[2].splitlines() if line.strip()]
    assert len(code) <= 20
