"""Whatever befalls the camera, the driver says so, accounts for every frame, and goes on when the camera is back."""

import os
import re
import subprocess
import sys
import time
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
    return [state for state, _ in driver.observed.states]


def test_a_stream_is_delivered_frame_by_frame(cameras: Cameras, drive: Drive, pictures: Path) -> None:
    rig = cameras(settings(pictures, faults=(Fault(0, Kind.JUNK, count=5000),)))
    driver = drive(rig, f"usb0{SPEC}")
    driver.wait_for_frames(1000)
    observed = driver.stop()
    assert states(driver)[-1] == "streaming"
    check_sent(observed, rig.report())


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
    seen = len(driver.observed.states)
    driver.wait_for_state("streaming", after=seen)
    driver.wait_for_frames(500)
    observed = driver.stop()
    assert fault.kind in rig.report().done
    check_sent(observed, rig.report())


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
    seen = len(driver.observed.states)
    driver.wait_for_state("streaming", after=seen)
    driver.wait_for_frames(500)
    observed = driver.stop()
    report = rig.report()
    order = [state for at, state in enumerate(states(driver)) if not at or state != states(driver)[at - 1]]
    lost = order.index("lost")
    back = order.index("armed", lost)
    assert order[lost : lost + 2] == ["lost", "absent"]
    assert set(order[lost + 2 : back]) <= {"lost"}, "a camera may be listed a moment before it can be opened"
    assert order[back : back + 2] == ["armed", "streaming"]
    assert "device" in {cause for _, _, cause in observed.gaps}
    # Besides the time that it was away, what it held for the host (up to 2 s) is gone.
    assert max(observed.offsets) - min(observed.offsets) < 3 * RATE, (
        "the gap is longer or shorter than the camera was away, by the clock"
    )
    check_sent(observed, report, offsets=2)


def test_a_capture_may_begin_before_there_is_a_camera(cameras: Cameras, drive: Drive, pictures: Path) -> None:
    rig = cameras(settings(pictures, plugged=False))
    driver = drive(rig, f"usb0{SPEC}")
    driver.wait_for_state("absent")
    assert "waiting for it" in driver.observed.states[0][1]
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
    assert "needs USB 3" in driver.observed.states[-1][1]
    rig.unplug()
    driver.wait_for_state("absent", after=len(driver.observed.states))
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
    observed = driver.wait_for(lambda observed: observed.error)
    assert "usb:2-1, usb:2-2" in (observed.error or "")


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
    observed = drive(rig, f"usb0{SPEC}").wait_for(lambda observed: observed.error)
    assert "used by another program" in (observed.error or "")
    first.wait_for_frames(100)
    check_sent(first.stop(), rig.report())


def test_a_usb2_port_is_an_error_that_says_so(cameras: Cameras, drive: Drive, pictures: Path) -> None:
    rig = cameras(settings(pictures, port="1-3", usb2=True))
    observed = drive(rig, "usb0").wait_for(lambda observed: observed.error)
    assert "camera at 1-3 is connected by USB 2, 480 Mbit/s, and needs USB 3" in (observed.error or "")


def test_a_buffer_beyond_the_kernels_limit_is_an_error_with_what_fits(
    cameras: Cameras, drive: Drive, pictures: Path
) -> None:
    observed = drive(cameras(settings(pictures)), "usb0?hide_ms=250").wait_for(lambda observed: observed.error)
    assert "15 transfers of 1024 KiB fit" in (observed.error or "")


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can become somebody who may not")
def test_a_user_without_permission_gets_the_udev_rule_to_add(cameras: Cameras, drive: Drive, pictures: Path) -> None:
    rig = cameras(settings(pictures, mode=0o600))
    observed = drive(rig, "usb0", user=65534).wait_for(lambda observed: observed.error)
    assert 'SUBSYSTEM=="usb", ATTR{idVendor}=="0403", ATTR{idProduct}=="601f"' in (observed.error or "")


def test_frames_lost_while_the_host_reads_nothing_have_the_cause_usb(
    cameras: Cameras, drive: Drive, pictures: Path
) -> None:
    """Half a second without room at the host is a loss of that length, on a machine of any speed."""
    rig = cameras(CameraSettings(str(pictures), rate_hz=RATE, buffer_frames=20))
    driver = drive(rig, f"usb0?rate={RATE}&silence_s=5&transfer_kib=64&hide_ms=50")
    driver.wait_for_frames(200)
    before = len(driver.observed.gaps)
    driver.pause()
    rig.wait_for(lambda report: report.room_bytes == 0)
    time.sleep(0.5)  # frames that the camera drops, but for the 20 that it keeps; a loaded machine may lose more
    driver.resume()
    driver.wait_for(lambda observed: any(count >= 0.45 * RATE for _, count, _ in observed.gaps[before:]))
    observed = driver.stop()
    assert {cause for _, count, cause in observed.gaps[before:] if count >= 0.45 * RATE} == {"usb"}
    check_sent(observed, rig.report())


@pytest.mark.parametrize("kind", [None, Kind.SILENCE])
def test_stopping_with_transfers_in_flight_takes_less_than_a_second(
    cameras: Cameras, drive: Drive, pictures: Path, kind: Kind | None
) -> None:
    rig = cameras(settings(pictures))
    driver = drive(rig, f"usb0?rate={RATE}&silence_s=60")
    driver.wait_for_frames(100)
    if kind:
        rig.fault(Fault(SOON, kind, seconds=30))
    observed = driver.stop()
    assert observed.closed_s is not None
    assert observed.closed_s < 1.0
    assert rig.report().in_flight_bytes == 0


def test_a_silent_camera_is_read_again_then_reset_then_waited_for(
    cameras: Cameras, drive: Drive, pictures: Path
) -> None:
    rig = cameras(settings(pictures))
    driver = drive(rig, f"usb0?rate={RATE}&silence_s=0.2&transfer_kib=256")
    driver.wait_for_frames(100)
    rig.fault(Fault(SOON, Kind.SILENCE, seconds=4.0))
    driver.wait_for(lambda observed: [state for state, _ in observed.states].count("lost") >= 2)
    driver.wait_for_frames(500)
    observed = driver.stop()
    check_sent(observed, rig.report())


def test_single_reads_deliver_the_same(cameras: Cameras, drive: Drive, pictures: Path) -> None:
    rig = cameras(settings(pictures))
    driver = drive(rig, f"usb0{SPEC}&transfers=single")
    driver.wait_for_frames(500)
    rig.fault(Fault(SOON, Kind.STALL))
    driver.wait_for_state("lost")
    driver.wait_for_frames(500)
    observed = driver.stop()
    check_sent(observed, rig.report())


def test_programs_that_begin_at_once_all_begin(cameras: Cameras, pictures: Path) -> None:
    """libusb_init fails now and then where another program registers with udev at the same moment."""
    rig = cameras(settings(pictures), settings(pictures, port="2-2"))
    code = "from spiked_driver.libusb import UsbContext\nfor _ in range(30): UsbContext().close()"
    several = [subprocess.Popen([sys.executable, "-c", code], env=dict(rig.environment)) for _ in range(3)]
    assert [one.wait(60) for one in several] == [0, 0, 0]


def test_old_frames_at_the_start_are_discarded_with_a_warning(cameras: Cameras, drive: Drive, pictures: Path) -> None:
    """As in the real bytes: one old frame in the FIFO, then the count jumps by 241,232."""
    old = (Fault(0, Kind.JUNK, count=4), Fault(1, Kind.DROP, count=241_231))
    rig = cameras(CameraSettings(str(pictures), faults=old))
    driver = drive(rig, "usb0")
    driver.wait_for_frames(500)
    observed = driver.stop()
    assert observed.gaps == []
    assert observed.offsets == [241_232], "the capture does not begin behind the jump"
    assert observed.warnings == [
        "1 old frame lay in the camera when the capture began, 241,232 frames before its first: discarded"
    ]
    check_sent(observed, rig.report())


def test_what_a_full_camera_kept_before_anybody_read_is_discarded(
    cameras: Cameras, drive: Drive, pictures: Path
) -> None:
    rig = cameras(CameraSettings(str(pictures), rate_hz=RATE, buffer_frames=30, fifo=True))
    full_s = rig.report().start_s + 60 / RATE
    time.sleep(max(0.0, full_s - time.monotonic()))
    driver = drive(rig, f"usb0{SPEC}&hide_ms=1000")
    driver.wait_for_frames(300)
    observed = driver.stop()
    assert observed.offsets[0] > 30
    told = re.match(r"(\d+) old frames lay in the camera", observed.warnings[0])
    assert told is not None and 0 < int(told[1]) <= 30  # a busy machine may lose some of them on their way
    check_sent(observed, rig.report())


def test_bytes_without_a_frame_end_the_capture_with_an_error(cameras: Cameras, drive: Drive, pictures: Path) -> None:
    rig = cameras(settings(pictures, magic=0x12345678))
    driver = drive(rig, f"usb0{SPEC}")
    observed = driver.wait_for(lambda observed: observed.error)
    assert [state for state, _ in observed.states] == ["armed", "lost"]
    reason = observed.states[-1][1]
    assert "MB read, no frame found; first bytes 78 56 34 12 21 00 10 00" in reason
    assert "2-1" in reason and "MB read, no frame found" in (observed.error or "")
    assert max(len(reason.encode()), len((observed.error or "").encode())) < 192, "the ring has no room for it"


def test_a_stream_that_loses_its_frames_is_lost_until_they_return(
    cameras: Cameras, drive: Drive, pictures: Path
) -> None:
    spoilt = tuple(Fault(number, Kind.FLIP, offset=2) for number in range(4 * RATE, 7 * RATE))
    rig = cameras(settings(pictures, faults=spoilt))
    driver = drive(rig, f"usb0?rate={RATE}&transfer_kib=256&silence_s=10")
    driver.wait_for_state("lost")
    assert "no frame found" in driver.observed.states[-1][1]
    driver.wait_for_state("streaming", after=len(driver.observed.states))
    driver.wait_for_frames(100)
    observed = driver.stop()
    assert observed.error is None
    assert sum(count for _, count, _ in observed.gaps) >= 3 * RATE
    check_sent(observed, rig.report())


def test_a_camera_named_by_its_serial_is_not_replaced_by_another(
    cameras: Cameras, drive: Drive, pictures: Path
) -> None:
    rig = cameras(settings(pictures, serial="SN-1"), settings(pictures, serial="SN-2", plugged=False))
    driver = drive(rig, f"usb:SN-1{SPEC}")
    driver.wait_for_frames(200)
    rig.unplug(0)
    driver.wait_for_state("absent")
    rig.plug(1, port="2-1")
    observed = driver.wait_for(lambda observed: "SN-2" in observed.states[-1][1])
    assert observed.states[-1][0] == "absent"
    assert rig.report(1).sent_frames == 0
    rig.unplug(1)
    rig.plug(0)
    driver.wait_for_frames(200)
    check_sent(driver.stop(), rig.report(0), offsets=2)


def test_another_camera_at_the_port_of_usb0_is_told(cameras: Cameras, drive: Drive, pictures: Path) -> None:
    rig = cameras(settings(pictures, serial="SN-1"), settings(pictures, serial="SN-2", plugged=False))
    driver = drive(rig, f"usb0{SPEC}")
    driver.wait_for_frames(200)
    rig.unplug(0)
    driver.wait_for_state("absent")
    rig.plug(1, port="2-1")
    driver.wait_for_frames(200)
    observed = driver.stop()
    assert observed.warnings == ["the camera at 2-1 was swapped: its serial number was SN-1 and is SN-2 now"]
    assert [cause for _, _, cause in observed.gaps] == ["device"]


@pytest.mark.parametrize("buffer_frames", [20, 200])
@pytest.mark.parametrize("stopped_s", [0.3, 2.5])
def test_a_suspended_host_loses_frames_of_cause_usb_only(
    cameras: Cameras, drive: Drive, pictures: Path, buffer_frames: int, stopped_s: float
) -> None:
    """Whatever the process is doing when it is stopped, and however much the camera can keep meanwhile."""
    rig = cameras(CameraSettings(str(pictures), rate_hz=RATE, buffer_frames=buffer_frames, fifo=True))
    driver = drive(rig, f"usb0?rate={RATE}&silence_s=1&transfer_kib=64&hide_ms=50")
    driver.wait_for_frames(200)
    before = len(driver.observed.gaps)
    for _ in range(3):
        driver.suspend(stopped_s)
        driver.wait_for_frames(3 * buffer_frames + 200)
    observed = driver.stop()
    assert {cause for _, _, cause in observed.gaps[before:]} == {"usb"}
    assert [state for state, _ in observed.states].count("lost") == 0
    check_sent(observed, rig.report())
