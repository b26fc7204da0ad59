"""From the camera through libusb, framing and the ring: each frame that comes out was sent so, or is told lost."""

from collections.abc import Callable
from pathlib import Path

import pytest
from virtual_camera.faults import Fault, Kind
from virtual_camera.host import CameraSettings
from virtual_camera.rig import VirtualCameras
from whole_driver import run

Cameras = Callable[..., VirtualCameras]


def test_as_fast_as_it_goes_nothing_is_lost(cameras: Cameras, pictures: Path) -> None:
    """Without a clock the camera waits for the driver, so only the driver could lose something."""
    rig = cameras(CameraSettings(str(pictures)), usbfs_memory_mb=64)
    account = run(rig, "usb0", 20_000, pictures)
    account.check(rig.report())
    assert account.lost.keys() <= {"ring"}  # the reader of this test is slower than the driver


def test_at_its_rate_all_is_accounted_for(cameras: Cameras, pictures: Path) -> None:
    rig = cameras(CameraSettings(str(pictures), rate_hz=20_000), usbfs_memory_mb=256)
    account = run(rig, "usb0", 60_000, pictures)
    account.check(rig.report())
    assert account.received > 0


def test_frames_that_the_camera_did_not_send_have_the_cause_device(cameras: Cameras, pictures: Path) -> None:
    faults = tuple(Fault(frame, Kind.DROP, count=count) for frame, count in ((1100, 3), (1500, 1), (3000, 700)))
    rig = cameras(CameraSettings(str(pictures), faults=faults), usbfs_memory_mb=64)
    account = run(rig, "usb0", 5000, pictures)
    account.check(rig.report())
    assert account.lost.get("device") == 704


def test_damage_on_the_way_costs_the_frames_it_hits(cameras: Cameras, pictures: Path) -> None:
    faults = (
        Fault(0, Kind.JUNK, count=5000),
        Fault(1100, Kind.FLIP, offset=3, count=0x10),  # in the magic
        Fault(1200, Kind.FLIP, offset=66, count=0x01),  # in a row number
        Fault(1300, Kind.LOSE, offset=4000, count=512),
        Fault(1400, Kind.CUT, offset=1000),
        Fault(1500, Kind.REPEAT, count=2),
    )
    rig = cameras(CameraSettings(str(pictures), faults=faults), usbfs_memory_mb=64)
    account = run(rig, "usb0", 4000, pictures)
    account.check(rig.report())
    assert account.lost.get("usb") == 3
    assert account.lost.get("device", 0) == 0


@pytest.mark.slow
def test_a_minute_at_its_rate_is_accounted_for_to_the_frame(cameras: Cameras, pictures: Path) -> None:
    """Ten minutes: `python evaluation/measure_usb.py losses`."""
    rig = cameras(CameraSettings(str(pictures), rate_hz=20_000), usbfs_memory_mb=256)
    account = run(rig, "usb0", 60 * 20_000, pictures)
    account.check(rig.report())
    assert account.received > 0
