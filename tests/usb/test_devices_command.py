"""`spiked devices` on machines with virtual cameras: what there is, how it stands, what to do."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from driving import Driver
from spiked_driver.usb_cameras import UDEV_RULES
from virtual_camera.host import CameraSettings
from virtual_camera.rig import VirtualCameras

Cameras = Callable[..., VirtualCameras]
Drive = Callable[..., Driver]


def spiked(*arguments: str, rig: VirtualCameras | None = None, code: int = 0) -> str:
    environment = {**(rig.environment if rig else os.environ), "COLUMNS": "200", "SPIKED_DEVICES": ""}
    command = [sys.executable, "-m", "spiked_service", *arguments]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == code, done.stderr
    return done.stdout


def test_cameras_are_listed_with_port_speed_and_serial(cameras: Cameras, pictures: Path) -> None:
    rig = cameras(
        CameraSettings(str(pictures), port="2-1.3", serial="SN-7"), CameraSettings(str(pictures), port="1-2", usb2=True)
    )
    text = spiked("devices", rig=rig)
    fast = next(line for line in text.splitlines() if line.startswith("usb:2-1.3"))
    assert all(word in fast for word in ("idle", "USB 3, 5 Gbit/s", "SN-7", "FT601"))
    assert "usb:1-2: the camera at 1-2 is connected by USB 2, 480 Mbit/s, and needs USB 3" in text
    assert "exposure not supported" in text
    slow, good = (
        next(device for device in json.loads(spiked("devices", "--json", rig=rig)) if device["source"] == source)
        for source in ("usb:1-2", "usb:2-1.3")
    )
    assert (good["state"], good["serial"], good["port"]) == ("idle", "SN-7", "2-1.3")
    assert good["capabilities"]["trigger_input"] == {"supported": False, "value": None}
    assert "USB 3" in slow["reason"]


def test_the_doctor_sees_the_slow_port_and_the_small_budget(cameras: Cameras, pictures: Path, tmp_path: Path) -> None:
    rig = cameras(CameraSettings(str(pictures), port="1-2", usb2=True), usbfs_memory_mb=16)
    found = spiked("devices", "--doctor", "--json", "--data", str(tmp_path), rig=rig, code=1)
    findings = {finding["name"]: finding for finding in json.loads(found)}
    assert findings["camera 1-2"]["status"] == "problem"
    assert findings["usbfs memory"]["status"] == "warning"
    assert "16 MiB for all cameras, 65 MiB are wanted" in findings["usbfs memory"]["finding"]
    assert "disk speed" in findings
    assert "problem  camera 1-2" in spiked("devices", "--doctor", "--data", str(tmp_path), rig=rig, code=1)


def test_the_doctor_shows_and_checks_the_bridge(cameras: Cameras, pictures: Path, tmp_path: Path) -> None:
    chips = {"2-1": (0, 0, 2), "2-2": (1, 1, 0), "2-3": (2, 0, 4), "2-4": (0, 0, 3), "2-5": (7, 0, 9)}
    rig = cameras(*(CameraSettings(str(pictures), port=port, chip=chip) for port, chip in chips.items()))
    found = json.loads(spiked("devices", "--doctor", "--json", "--data", str(tmp_path), rig=rig, code=1))
    bridges = {item["name"].removeprefix("bridge "): item for item in found if item["name"].startswith("bridge")}
    assert {port: item["status"] for port, item in bridges.items()} == {
        "2-1": "ok",
        "2-2": "warning",
        "2-3": "problem",
        "2-4": "problem",
        "2-5": "warning",
    }
    assert bridges["2-1"]["finding"] == "FT601: FIFO mode 245, 100 MHz, one channel"
    assert "FIFO mode 600, 66 MHz, four channels" in bridges["2-2"]["finding"]
    assert "carries 200 MB/s at 50 MHz, and the camera sends 260" in bridges["2-3"]["finding"]
    assert "no channel to the host" in bridges["2-4"]["finding"]
    assert "unknown clock, unknown channels" in bridges["2-5"]["finding"]
    assert "FT60X configuration programmer" in bridges["2-2"]["what_to_do"]


def test_the_doctor_asks_a_bridge_that_is_being_read(cameras: Cameras, pictures: Path, drive: Drive) -> None:
    rig = cameras(CameraSettings(str(pictures), rate_hz=1000, buffer_frames=2000))
    driver = drive(rig, "usb0?rate=1000&transfer_kib=256")
    driver.wait_for_frames(100)
    text = spiked("devices", "--doctor", rig=rig)
    assert "bridge 2-1: FT601: FIFO mode 245" in text
    driver.wait_for_frames(100)
    assert driver.stop().gaps == []


def test_the_rules_come_ready_to_install() -> None:
    assert spiked("devices", "--udev-rules") == UDEV_RULES + "\n"
