"""Bridges that want to be read in one way only: found by trial, and told by `spiked devices --probe`."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from driving import Driver, check_sent
from virtual_camera.core import Bridge
from virtual_camera.faults import Fault, Kind
from virtual_camera.host import CameraSettings
from virtual_camera.rig import VirtualCameras

Cameras = Callable[..., VirtualCameras]
Drive = Callable[..., Driver]

RATE = 1000
SPEC = f"usb0?rate={RATE}&silence_s=0.3&transfer_kib=256"
ABORT, STREAM, FLUSH = 0, 2, 3


def camera(pictures: Path, bridge: Bridge = Bridge.ALL, **more: object) -> CameraSettings:
    return CameraSettings(str(pictures), rate_hz=RATE, buffer_frames=4 * RATE, bridge=bridge, **more)  # type: ignore[arg-type]


def test_a_bridge_that_only_streams_is_found_by_trial_and_the_trial_told(
    cameras: Cameras, drive: Drive, pictures: Path
) -> None:
    rig = cameras(camera(pictures, Bridge.STREAM))
    driver = drive(rig, SPEC)
    driver.wait_for_frames(500)
    observed = driver.stop()
    assert observed.warnings == [
        "the camera at 2-1 sends nothing in answer to read requests: stream mode is tried",
        "the camera at 2-1 sends with stream mode: `session=stream` saves the trial",
    ]
    check_sent(observed, rig.report())


@pytest.mark.parametrize("transfers", ["queued", "single"])
@pytest.mark.parametrize("session", ["request", "stream"])
def test_a_stated_session_is_used_at_once_and_ended_at_close(
    cameras: Cameras, drive: Drive, pictures: Path, session: str, transfers: str
) -> None:
    rig = cameras(camera(pictures))
    driver = drive(rig, f"{SPEC}&session={session}&transfers={transfers}")
    driver.wait_for_frames(300)
    begun = rig.report()
    assert begun.commands == ((ABORT, STREAM) if session == "stream" else ()), "a fresh handle is not flushed"
    assert bool(begun.requests) == (session == "request")
    observed = driver.stop()
    assert observed.warnings == []
    report = rig.report()
    assert report.commands == (*begun.commands, ABORT, FLUSH)
    assert report.bad_requests == 0


def test_a_stated_session_that_brings_nothing_is_not_left(cameras: Cameras, drive: Drive, pictures: Path) -> None:
    rig = cameras(camera(pictures, Bridge.STREAM))
    driver = drive(rig, f"{SPEC}&session=request")
    driver.wait_for_state("lost")
    driver.wait_for(lambda observed: [state for state, _ in observed.states].count("lost") > 1)
    assert STREAM not in rig.report().commands
    assert driver.stop().received == 0


def test_after_trouble_the_bridge_is_aborted_and_flushed(cameras: Cameras, drive: Drive, pictures: Path) -> None:
    rig = cameras(camera(pictures))
    driver = drive(rig, SPEC)
    driver.wait_for_frames(100)
    rig.fault(Fault(1, Kind.STALL))
    driver.wait_for_state("lost")
    driver.wait_for_frames(300)
    assert rig.report().commands == (ABORT, FLUSH)
    check_sent(driver.stop(), rig.report())


def test_the_bridge_never_holds_more_requests_than_the_cap(cameras: Cameras, drive: Drive, pictures: Path) -> None:
    rig = cameras(camera(pictures, Bridge.SINGLE))
    driver = drive(rig, f"{SPEC}&session=request&requests=1")
    driver.wait_for_frames(500)
    check_sent(driver.stop(), rig.report())


def probe(rig: VirtualCameras, *options: str, code: int = 0) -> tuple[str, str]:
    command = [sys.executable, "-m", "spiked_service", "devices", "--probe", "usb0", *options]
    environment = {**rig.environment, "COLUMNS": "160", "SPIKED_DEVICES": ""}
    begun_s = time.monotonic()
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60, check=False)
    print(f"{time.monotonic() - begun_s:.1f} s")
    assert done.returncode == code, done.stdout + done.stderr
    return done.stdout, done.stderr


@pytest.mark.parametrize(
    ("bridge", "verdicts"),
    [
        (Bridge.REQUEST, ("frames", "nothing", "frames")),
        (Bridge.SINGLE, ("stopped", "nothing", "frames")),
        (Bridge.NOTHING, ("nothing", "nothing", "nothing")),
    ],
)
def test_the_probe_says_which_way_works(
    cameras: Cameras, pictures: Path, bridge: Bridge, verdicts: tuple[str, ...]
) -> None:
    told = json.loads(probe(cameras(camera(pictures, bridge)), "--json", code=int(bridge is Bridge.NOTHING))[0])
    assert tuple(way["verdict"] for way in told["ways"]) == verdicts
    assert sum(way["seconds"] for way in told["ways"]) < 7
    for way in told["ways"]:
        assert (way["frames"] > 0) == (way["verdict"] in ("frames", "stopped")) == bool(way["first_bytes"])


def test_the_probe_says_what_to_do(cameras: Cameras, pictures: Path) -> None:
    text, said = probe(cameras(camera(pictures, Bridge.STREAM)))
    assert "camera at 2-1: FT601, serial 000000000001, USB 3" in text
    assert "bridge: FIFO mode 245, 100 MHz, one channel" in text
    lines = text.splitlines()
    assert ["frames (" in line for line in lines[3:6]] == [False, True, False]
    assert lines[-1] == "use it so: spiked serve --device 'usb:2-1?session=stream'"
    assert "trying stream mode" in said


def test_the_probe_shows_bytes_that_are_no_frames(cameras: Cameras, pictures: Path) -> None:
    rig = cameras(camera(pictures, magic=0x12345678))
    text, _ = probe(rig, code=1)
    assert text.count("bytes, but no frame") == 3 and "first bytes: 78 56 34 12" in text


def test_a_camera_in_use_is_not_probed(cameras: Cameras, drive: Drive, pictures: Path) -> None:
    rig = cameras(camera(pictures))
    driver = drive(rig, SPEC)
    driver.wait_for_frames(100)
    _, said = probe(rig, code=2)
    assert "is used by another program or capture: end it first" in said
    driver.wait_for_frames(100)
    assert driver.stop().gaps == []


@pytest.mark.parametrize("source", ["sim:", "usb0?session=stream", "nothing", "usb:9-9"])
def test_what_cannot_be_probed_is_refused(cameras: Cameras, pictures: Path, source: str) -> None:
    rig = cameras(camera(pictures))
    command = [sys.executable, "-m", "spiked_service", "devices", "--probe", source]
    done = subprocess.run(
        command, env={**os.environ, **rig.environment}, capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert "cannot be probed" in done.stderr or "there is no camera" in done.stderr
