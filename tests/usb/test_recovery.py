"""Whatever befalls the camera, the driver says so, accounts for every frame, and goes on when the camera is back."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from driving import Driver, check_sent
from virtual_camera.faults import Fault, Kind
from virtual_camera.host import CameraSettings
from virtual_camera.rig import VirtualCameras

Cameras = Callable[..., VirtualCameras]
Drive = Callable[..., Driver]

RATE = 1000
SPEC = f"?rate={RATE}&silence_s=0.5&transfer_kib=256"
SOON = 1
"""A frame that has gone by: now."""


def settings(pictures: Path, port: str = "2-1", **more: object) -> CameraSettings:
    """A slow camera with room for two seconds, so that a loaded machine loses nothing by itself."""
    return CameraSettings(str(pictures), rate_hz=RATE, buffer_frames=2 * RATE, port=port, **more)  # type: ignore[arg-type]


def states(driver: Driver) -> list[str]:
    return [state for state, _ in driver.told.states]


def test_a_stream_is_delivered_frame_by_frame(cameras: Cameras, drive: Drive, pictures: Path) -> None:
    rig = cameras(settings(pictures, faults=(Fault(0, Kind.JUNK, count=5000),)))
    driver = drive(rig, f"usb0{SPEC}")
    driver.wait_for_frames(1000)
    told = driver.stop()
    assert states(driver)[-1] == "streaming"
    check_sent(told, rig.report())


@pytest.mark.parametrize(
    "fault",
    [Fault(SOON, Kind.STALL), Fault(SOON, Kind.BABBLE), Fault(SOON, Kind.SILENCE, seconds=1.2)],
    ids=lambda fault: fault.kind,
)
def test_a_camera_that_fails_and_recovers_has_kept_its_count(
    cameras: Cameras, drive: Drive, pictures: Path, fault: Fault
) -> None:
    rig = cameras(settings(pictures))
    driver = drive(rig, f"usb0{SPEC}")
    driver.wait_for_frames(100)
    rig.fault(fault)
    driver.wait_for_state("lost")
    seen = len(driver.told.states)
    driver.wait_for_state("streaming", after=seen)
    driver.wait_for_frames(500)
    told = driver.stop()
    assert fault.kind in rig.report().done
    check_sent(told, rig.report())


@pytest.mark.parametrize("port", ["2-1", "2-4.1"])
def test_an_unplugged_camera_is_waited_for_wherever_it_comes_back(
    cameras: Cameras, drive: Drive, pictures: Path, port: str
) -> None:
    rig = cameras(settings(pictures))
    driver = drive(rig, f"usb0{SPEC}")
    driver.wait_for_frames(500)
    rig.unplug()
    driver.wait_for_state("absent")
    rig.plug(port=port)
    seen = len(driver.told.states)
    driver.wait_for_state("streaming", after=seen)
    driver.wait_for_frames(500)
    told = driver.stop()
    report = rig.report()
    order = [state for at, state in enumerate(states(driver)) if not at or state != states(driver)[at - 1]]
    lost = order.index("lost")
    assert order[lost : lost + 4] == ["lost", "absent", "armed", "streaming"]
    assert "device" in {cause for _, _, cause in told.gaps}
    before, after = told.offsets
    # Besides the time that it was away, what it held for the host (up to 2 s) is gone.
    assert abs(after - before) < 3 * RATE, "the gap is longer or shorter than the camera was away, by the clock"
    check_sent(told, report, offsets=2)


def test_a_capture_may_begin_before_there_is_a_camera(cameras: Cameras, drive: Drive, pictures: Path) -> None:
    rig = cameras(settings(pictures, plugged=False))
    driver = drive(rig, f"usb0{SPEC}")
    driver.wait_for_state("absent")
    assert "waiting for it" in driver.told.states[0][1]
    rig.plug()
    driver.wait_for_frames(200)
    check_sent(driver.stop(), rig.report())


def test_a_camera_that_comes_to_a_slow_port_is_seen_and_not_used(
    cameras: Cameras, drive: Drive, pictures: Path
) -> None:
    rig = cameras(settings(pictures, plugged=False, usb2=True))
    driver = drive(rig, f"usb0{SPEC}")
    driver.wait_for_state("absent")
    rig.plug()
    driver.wait_for_state("idle")
    assert "needs USB 3" in driver.told.states[-1][1]
    rig.unplug()
    driver.wait_for_state("absent", after=len(driver.told.states))
    assert driver.stop().received == 0


def test_two_cameras_do_not_get_mixed_up(cameras: Cameras, drive: Drive, pictures: Path) -> None:
    rig = cameras(settings(pictures), settings(pictures, port="2-2"), usbfs_memory_mb=64)
    first, second = drive(rig, f"usb0{SPEC}"), drive(rig, f"usb:2-2{SPEC}")
    first.wait_for_frames(200)
    second.wait_for_frames(200)
    rig.unplug(0)
    first.wait_for_state("absent")
    second.wait_for_frames(1000)
    assert states(first)[-1] == "absent", "it took the other camera"
    rig.plug(0)
    first.wait_for_frames(200)
    check_sent(first.stop(), rig.report(0), offsets=2)
    check_sent(second.stop(), rig.report(1))


def test_a_reset_hub_takes_both_cameras_and_gives_each_back_to_its_capture(
    cameras: Cameras, drive: Drive, pictures: Path
) -> None:
    rig = cameras(settings(pictures, port="2-1.1"), settings(pictures, port="2-1.2"), usbfs_memory_mb=64)
    drivers = [drive(rig, f"usb{number}{SPEC}") for number in range(2)]
    for driver in drivers:
        driver.wait_for_frames(200)
    rig.unplug(0)
    rig.unplug(1)
    for driver in drivers:
        driver.wait_for_state("absent")
    rig.plug(1)  # the order in which they come back is any
    drivers[1].wait_for_frames(200)
    assert states(drivers[0])[-1] == "absent"
    rig.plug(0)
    drivers[0].wait_for_frames(200)
    for number, driver in enumerate(drivers):
        check_sent(driver.stop(), rig.report(number), offsets=2)


def test_cameras_with_the_same_serial_must_be_named_by_port(cameras: Cameras, drive: Drive, pictures: Path) -> None:
    rig = cameras(settings(pictures), settings(pictures, port="2-2"))
    driver = drive(rig, "usb:000000000001")
    told = driver.wait_for(lambda told: told.error)
    assert "usb:2-1, usb:2-2" in (told.error or "")


def test_a_camera_is_found_by_its_serial(cameras: Cameras, drive: Drive, pictures: Path) -> None:
    rig = cameras(settings(pictures), settings(pictures, port="2-2", serial="SN-4"), usbfs_memory_mb=64)
    driver = drive(rig, f"usb:SN-4{SPEC}")
    driver.wait_for_frames(100)
    driver.stop()
    assert rig.report(1).sent_frames > 0
    assert rig.report(0).sent_frames == 0


def test_a_camera_in_use_is_not_taken(cameras: Cameras, drive: Drive, pictures: Path) -> None:
    rig = cameras(settings(pictures), usbfs_memory_mb=64)
    first = drive(rig, f"usb0{SPEC}")
    first.wait_for_frames(100)
    told = drive(rig, f"usb0{SPEC}").wait_for(lambda told: told.error)
    assert "used by another program" in (told.error or "")
    first.wait_for_frames(100)
    check_sent(first.stop(), rig.report())


def test_a_usb2_port_is_an_error_that_says_so(cameras: Cameras, drive: Drive, pictures: Path) -> None:
    rig = cameras(settings(pictures, port="1-3", usb2=True))
    told = drive(rig, "usb0").wait_for(lambda told: told.error)
    assert "camera at 1-3 is connected by USB 2, 480 Mbit/s, and needs USB 3" in (told.error or "")


def test_a_camera_in_the_budget_of_nobody_says_what_fits(cameras: Cameras, drive: Drive, pictures: Path) -> None:
    told = drive(cameras(settings(pictures)), "usb0?hide_ms=250").wait_for(lambda told: told.error)
    assert "15 transfers of 1024 KiB fit" in (told.error or "")


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can become somebody who may not")
def test_who_may_not_is_told_the_rule_that_helps(cameras: Cameras, drive: Drive, pictures: Path) -> None:
    rig = cameras(settings(pictures, mode=0o600))
    told = drive(rig, "usb0", user=65534).wait_for(lambda told: told.error)
    assert 'SUBSYSTEM=="usb", ATTR{idVendor}=="0403", ATTR{idProduct}=="601f"' in (told.error or "")


def test_a_dozing_host_loses_frames_and_says_that_it_was_the_host(
    cameras: Cameras, drive: Drive, pictures: Path
) -> None:
    rig = cameras(CameraSettings(str(pictures), rate_hz=RATE, buffer_frames=20))
    driver = drive(rig, f"usb0?rate={RATE}&silence_s=5&transfer_kib=64&hide_ms=50")
    driver.wait_for_frames(200)
    before = len(driver.told.gaps)
    driver.doze()
    # The doze lasts a second, of which 0.05 are hidden; a loaded machine may lose more before and after it.
    driver.wait_for(lambda told: sum(count for _, count, cause in told.gaps[before:] if cause == "usb") > 0.3 * RATE)
    told = driver.stop()
    check_sent(told, rig.report())


@pytest.mark.parametrize("kind", [None, Kind.SILENCE])
def test_stopping_with_transfers_in_flight_takes_less_than_a_second(
    cameras: Cameras, drive: Drive, pictures: Path, kind: Kind | None
) -> None:
    rig = cameras(settings(pictures))
    driver = drive(rig, f"usb0?rate={RATE}&silence_s=60")
    driver.wait_for_frames(100)
    if kind:
        rig.fault(Fault(SOON, kind, seconds=30))
    told = driver.stop()
    assert told.closed_s is not None
    assert told.closed_s < 1.0
    assert rig.report().in_flight_bytes == 0


def test_a_camera_that_stays_silent_is_asked_again_and_reset_and_waited_for(
    cameras: Cameras, drive: Drive, pictures: Path
) -> None:
    rig = cameras(settings(pictures))
    driver = drive(rig, f"usb0?rate={RATE}&silence_s=0.2&transfer_kib=256")
    driver.wait_for_frames(100)
    rig.fault(Fault(SOON, Kind.SILENCE, seconds=4.0))
    driver.wait_for(lambda told: [state for state, _ in told.states].count("lost") >= 2)
    driver.wait_for_frames(500)
    told = driver.stop()
    check_sent(told, rig.report())


def test_single_reads_deliver_the_same(cameras: Cameras, drive: Drive, pictures: Path) -> None:
    rig = cameras(settings(pictures))
    driver = drive(rig, f"usb0{SPEC}&transfers=single")
    driver.wait_for_frames(500)
    rig.fault(Fault(SOON, Kind.STALL))
    driver.wait_for_state("lost")
    driver.wait_for_frames(500)
    told = driver.stop()
    check_sent(told, rig.report())


def test_programs_that_begin_at_once_all_begin(cameras: Cameras, pictures: Path) -> None:
    """libusb_init fails now and then where another program registers with udev at the same moment."""
    rig = cameras(settings(pictures), settings(pictures, port="2-2"))
    code = "from spiked_driver.libusb import UsbContext\nfor _ in range(30): UsbContext().close()"
    several = [subprocess.Popen([sys.executable, "-c", code], env=dict(rig.environment)) for _ in range(3)]
    assert [one.wait(60) for one in several] == [0, 0, 0]
