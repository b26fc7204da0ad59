"""The rig itself: what the virtual camera shows to an unmodified libusb, pyusb and kernel interface."""

import errno
import os
from collections.abc import Callable
from pathlib import Path

import pytest
from virtual_camera.faults import Fault, Kind
from virtual_camera.host import CameraSettings
from virtual_camera.rig import VirtualCameras
from virtual_camera.stream import FRAME_BYTES, ROWS
from wire_facts import assert_sent, frames_of, lines_of

HIGH, SUPER = 3, 4
READ_BYTES = 1 << 16


def test_libusb_lists_it_as_the_bridge_it_is(cameras: Callable[..., VirtualCameras], pictures: Path) -> None:
    rig = cameras(
        CameraSettings(str(pictures), port="2-1.3"), CameraSettings(str(pictures), port="1-4", usb2=True, serial="17")
    )
    one, two = sorted(rig.call("devices"), key=lambda device: -device["bus"])
    assert one == {
        "product": 0x601F,
        "bus": 2,
        "ports": [1, 3],
        "speed": SUPER,
        "serial": "000000000001",
        "name": "FTDI SuperSpeed-FIFO Bridge",
    }
    assert (two["bus"], two["ports"], two["speed"], two["serial"]) == (1, [4], HIGH, "17")
    configuration = bytes.fromhex(rig.call("chip_configuration"))
    assert len(configuration) == 152
    assert configuration[:4] == bytes.fromhex("03041f60")


@pytest.mark.parametrize("direct", [True, False])
def test_what_it_sends_is_what_the_wire_says(
    cameras: Callable[..., VirtualCameras], pictures: Path, tmp_path: Path, direct: bool
) -> None:
    start = (1 << 32) - 2 * ROWS  # both counters wrap on the way
    rig = cameras(CameraSettings(str(pictures), lines=start, nbytes=50 * start & 0xFFFFFFFF), direct_memory=direct)
    answer = rig.call("read", str(tmp_path / "wire"), 5)
    assert answer == {"lengths": [READ_BYTES] * 5, "errno": None}
    frames = frames_of(tmp_path / "wire")
    assert len(frames) == 5 * READ_BYTES // FRAME_BYTES
    assert_sent(frames, pictures, start)
    report = rig.report()
    assert report.requests == tuple((index, READ_BYTES) for index in range(5))
    assert report.sent_frames == report.next_frame == -(-5 * READ_BYTES // FRAME_BYTES)


def test_nothing_comes_that_was_not_asked_for(
    cameras: Callable[..., VirtualCameras], pictures: Path, tmp_path: Path
) -> None:
    rig = cameras(CameraSettings(str(pictures)))
    answer = rig.call("read", str(tmp_path / "wire"), 1, ask=False, timeout_ms=100)
    assert answer == {"lengths": [], "errno": errno.ETIMEDOUT}


def test_a_camera_with_a_clock_does_not_wait(
    cameras: Callable[..., VirtualCameras], pictures: Path, tmp_path: Path
) -> None:
    rig = cameras(CameraSettings(str(pictures), rate_hz=20_000, buffer_frames=10))
    rig.call("read", str(tmp_path / "wire"), 20)
    report = rig.report()
    numbers = lines_of(frames_of(tmp_path / "wire"))
    assert numbers[0] > 10  # more than its buffer holds went by before anybody read
    assert numbers == sorted(set(numbers))
    assert report.dropped + report.sent_frames == report.next_frame
    assert all(report.runs(number) for number in numbers)


@pytest.mark.parametrize(
    ("fault", "numbers"),
    [
        (Fault(3, Kind.DROP, count=4), [0, 1, 2, 7, 8]),
        (Fault(2, Kind.REPEAT, count=2), [0, 1, 2, 2, 2, 3]),
    ],
)
def test_dropped_and_repeated_frames(
    cameras: Callable[..., VirtualCameras], pictures: Path, tmp_path: Path, fault: Fault, numbers: list[int]
) -> None:
    rig = cameras(CameraSettings(str(pictures), faults=(fault,)))
    rig.call("read", str(tmp_path / "wire"), 3)
    assert lines_of(frames_of(tmp_path / "wire"))[: len(numbers)] == numbers
    assert rig.report().done == (fault.kind,)


def test_damage_of_the_bytes(cameras: Callable[..., VirtualCameras], pictures: Path, tmp_path: Path) -> None:
    faults = (
        Fault(0, Kind.JUNK, count=40),
        Fault(2, Kind.FLIP, offset=500, count=0x81),
        Fault(3, Kind.LOSE, offset=1000, count=36),
        Fault(4, Kind.CUT, offset=700),
    )
    plain, spoilt = cameras(CameraSettings(str(pictures))), cameras(CameraSettings(str(pictures), faults=faults))
    plain.call("read", str(tmp_path / "plain"), 2)
    answer = spoilt.call("read", str(tmp_path / "spoilt"), 3)
    assert answer["lengths"] == [40 + 4 * FRAME_BYTES - 36 + 700, READ_BYTES, READ_BYTES]
    sent, came = (tmp_path / "plain").read_bytes(), (tmp_path / "spoilt").read_bytes()[40:]
    flipped, lost = 2 * FRAME_BYTES + 500, 3 * FRAME_BYTES + 1000
    assert came[:flipped] == sent[:flipped]
    assert came[flipped] == sent[flipped] ^ 0x81
    assert came[flipped + 1 : lost] == sent[flipped + 1 : lost]
    assert came[lost : lost + READ_BYTES // 2] == sent[lost + 36 : lost + 36 + READ_BYTES // 2]


def test_stall_and_babble_and_silence_are_the_kernels_errors(
    cameras: Callable[..., VirtualCameras], pictures: Path, tmp_path: Path
) -> None:
    faults = (Fault(10, Kind.STALL), Fault(20, Kind.BABBLE), Fault(30, Kind.SILENCE, seconds=1.3))
    rig = cameras(CameraSettings(str(pictures), faults=faults))
    answer = rig.call("read_through_stalls", str(tmp_path / "wire"), 12)
    assert answer == {"errors": [errno.EPIPE, errno.EOVERFLOW, errno.ETIMEDOUT], "reads": 12}


def test_unplugged_and_back_at_another_port(
    cameras: Callable[..., VirtualCameras], pictures: Path, tmp_path: Path
) -> None:
    faults = (Fault(30, Kind.UNPLUG, seconds=0.3, port="2-2"),)
    rig = cameras(CameraSettings(str(pictures), faults=faults))
    answer = rig.call("read", str(tmp_path / "wire"), 50)
    assert answer["errno"] in (errno.ENODEV, errno.EIO)
    assert sum(answer["lengths"]) // FRAME_BYTES <= 30
    rig.wait_for(lambda report: report.plugged)
    assert [device["ports"] for device in rig.call("devices")] == [[2]]
    assert rig.call("read", str(tmp_path / "again"), 3)["errno"] is None
    assert lines_of(frames_of(tmp_path / "again"))[0] == 1000 // ROWS  # a camera switched on counts anew
    rig.unplug()
    assert rig.call("devices") == []


def test_the_kernel_refuses_more_memory_than_it_lends(cameras: Callable[..., VirtualCameras], pictures: Path) -> None:
    rig = cameras(CameraSettings(str(pictures)), usbfs_memory_mb=16)
    assert rig.call("submit_until_refused", 1 << 20) == [15, errno.ENOMEM]
    assert (rig.root / "sys/module/usbcore/parameters/usbfs_memory_mb").read_text() == "16\n"


def test_a_discarded_transfer_comes_back(cameras: Callable[..., VirtualCameras], pictures: Path) -> None:
    rig = cameras(CameraSettings(str(pictures)))
    answer = rig.call("poll_and_discard")
    assert answer == {"ready": [0, 1, 0], "same": True, "status": -errno.ENOENT, "actual": 0}


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can become somebody who may not")
def test_not_everybody_may(cameras: Callable[..., VirtualCameras], pictures: Path) -> None:
    rig = cameras(CameraSettings(str(pictures), mode=0o600))
    assert rig.call("refused", user=65534) == errno.EACCES
    rig.permit(0o666)
    assert rig.call("refused", user=65534) is None
