"""The whole way: a virtual camera on a mocked machine, the daemon, a capture over REST, bytes and a reconstruction."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from virtual_camera.host import CameraSettings
from virtual_camera.rig import VirtualCameras

from spiked.sensor import Sensor
from spiked.simulate import SimulatedCamera
from spiked.simulate.record import simulate

RATE = 2000
FRAMES = 1000
FOV_DEG = 60.0
PATIENCE_S = 240.0


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of a camera that moves through a room, as long as the captures here."""
    folder = tmp_path_factory.mktemp("usb") / "room"
    simulate(SimulatedCamera(Sensor(400, 250, 20_000.0), seed=3), folder, "room", FRAMES, views=2)
    return folder / "room.dat"


def wait_for(condition: Callable[[], Any], what: str) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline_s, f"not so within {PATIENCE_S:g} s: {what}"
        time.sleep(0.05)


def sent(room: Path, numbers: range) -> NDArray[np.uint8]:
    """Frames as the camera sent them, each with its number in the first 8 bytes; uint8 [n, 12500]."""
    frames = np.fromfile(room, np.uint8).reshape(-1, 12_500)[numbers]
    frames[:, :8] = np.array(numbers, "<i8").view(np.uint8).reshape(-1, 8)
    return frames


def test_a_capture_over_rest_gets_every_frame_and_is_reconstructed(
    cameras: Callable[..., VirtualCameras], daemon: Callable[..., Any], room: Path, tmp_path: Path
) -> None:
    rig = cameras(CameraSettings(str(room), plugged=False))
    http = daemon("--device", f"usb0?fov={FOV_DEG:g}&rate={RATE}", "--no-capture", seen=rig).http
    device = http.get("devices").json()["items"][0]
    assert (device["source"], device["kind"]) == (f"usb0?fov={FOV_DEG:g}&rate={RATE}", "usb")
    assert (device["state"], device["port"]) == ("absent", None)
    body = {"source": device["source"], "frames": FRAMES, "options": {"steps": 20}}
    capture_id = http.post("captures", json=body).json()["id"]

    def counters() -> dict[str, Any]:
        return http.get(f"captures/{capture_id}").json().get("counters") or {}

    wait_for(lambda: (counters().get("device") or "").startswith("absent"), "the daemon waits for the camera")
    rig.plug()
    over = ("finishing", "complete", "failed")
    wait_for(lambda: http.get(f"captures/{capture_id}").json()["state"] in over, "all frames came")
    device = http.get("devices").json()["items"][0]
    assert (device["state"], device["port"], device["serial"]) == ("idle", "2-1", "000000000001")
    doctor = {item["name"]: item for item in http.get("doctor").json()["items"]}
    assert doctor["camera 2-1"]["status"] == "ok"
    assert doctor["usbfs memory"]["status"] == "warning"
    assert "usbfs_memory_mb" in doctor["usbfs memory"]["what_to_do"]
    assert device["capabilities"]["exposure"] == {"supported": False, "value": None}
    capture = http.get(f"captures/{capture_id}").json()
    assert capture["reason"] == ""
    assert capture["counters"]["received"] == FRAMES
    assert sum(capture["counters"]["lost"].values()) == 0
    wait_for(lambda: http.get(f"captures/{capture_id}").json()["recording"], "the recording is closed")
    recorded = (tmp_path / "data" / "captures" / capture_id / "recording.dat").read_bytes()
    assert recorded == sent(room, range(FRAMES)).tobytes()

    def job() -> dict[str, Any]:
        found: dict[str, Any] = http.get(f"reconstructions/{capture['reconstruction_ids'][0]}").json()
        return found

    wait_for(lambda: job()["poses"] > 0, "the reconstruction follows")
    assert job()["state"] in ("running", "complete")


def test_a_capture_goes_on_when_the_camera_is_back(
    cameras: Callable[..., VirtualCameras], daemon: Callable[..., Any], room: Path
) -> None:
    rig = cameras(CameraSettings(str(room), rate_hz=RATE, buffer_frames=2 * RATE))
    http = daemon("--device", f"usb0?fov={FOV_DEG:g}&rate={RATE}&transfer_kib=256", seen=rig).http
    capture_id = http.get("captures").json()["items"][0]["id"]

    def counters() -> dict[str, Any]:
        return http.get(f"captures/{capture_id}").json().get("counters") or {}

    wait_for(lambda: counters().get("received", 0) > 100, "frames come")
    rig.unplug()
    wait_for(lambda: counters()["device"].startswith("absent"), "it is seen that the camera is gone")
    before = counters()["received"]
    rig.plug(port="2-5")
    wait_for(lambda: counters()["received"] > before + 500, "frames come again")
    after = counters()
    assert after["device"].startswith("streaming")
    assert after["lost"]["device"] > 0
    assert after["received"] + sum(after["lost"].values()) == after["next_frame"]
