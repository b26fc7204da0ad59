"""Cameras as sysfs shows them: which there are, which is meant, what is wrong with them."""

import os
from pathlib import Path

import pytest
from spiked_driver import usb_cameras
from spiked_driver.usb_cameras import UDEV_RULES, CameraChoice, NotUsableError, UsbCamera, find_cameras

from spiked.errors import SourceError

FACTORY = "000000000001"
DEPLOYED = Path(__file__).parents[2] / "deploy" / "udev" / "70-spiked.rules"


@pytest.fixture
def sysfs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(usb_cameras, "SYSFS", tmp_path)
    return tmp_path


def add(sysfs: Path, port: str, **values: str) -> None:
    folder = sysfs / port
    folder.mkdir()
    bus = port.partition("-")[0]
    defaults = {"idVendor": "0403", "idProduct": "601f", "busnum": bus, "devnum": "7", "speed": "5000"}
    for name, value in {**defaults, "serial": FACTORY, "bcdDevice": "0106", **values}.items():
        (folder / name).write_text(f"{value}\n")


def camera(port: str, serial: str = FACTORY, speed: float = 5000, address: int = 7) -> UsbCamera:
    return UsbCamera(port, int(port.partition("-")[0]), address, 0x601F, serial, speed, "1.06")


def test_cameras_are_found_by_vendor_and_product_in_the_order_of_their_ports(sysfs: Path) -> None:
    for port in ("2-10", "2-9.2", "2-9.1"):
        add(sysfs, port)
    add(sysfs, "2-1", idVendor="1d6b")
    add(sysfs, "2-2", idProduct="6001")
    (sysfs / "usb2").mkdir()
    (sysfs / "2-9:1.0").mkdir()
    assert [each.port for each in find_cameras()] == ["2-9.1", "2-9.2", "2-10"]
    assert find_cameras()[2] == camera("2-10")
    assert find_cameras()[0].node == Path("/dev/bus/usb/002/007")


def test_a_camera_that_vanishes_while_it_is_read_is_not_there(sysfs: Path) -> None:
    add(sysfs, "2-1")
    (sysfs / "2-1" / "devnum").unlink()
    assert find_cameras() == []


def test_what_the_kernel_does_not_know_is_not_known(sysfs: Path) -> None:
    add(sysfs, "2-1", speed="unknown", bcdDevice="x")
    (sysfs / "2-1" / "serial").unlink()
    found = find_cameras()[0]
    assert (found.serial, found.speed_mbps, found.firmware) == (None, None, None)
    assert found.speed == "unknown speed"
    assert found.speed_problem() is None


def test_a_machine_without_usb_has_no_cameras(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(usb_cameras, "SYSFS", tmp_path / "none")
    assert find_cameras() == []


def test_a_slow_port_is_an_error_that_says_so() -> None:
    problem = camera("1-3", speed=480).speed_problem()
    assert problem is not None
    assert "camera at 1-3 is connected by USB 2, 480 Mbit/s, and needs USB 3" in problem
    assert camera("1-3", speed=10_000).speed == "USB 3, 10 Gbit/s"


def test_a_camera_that_may_not_be_opened_comes_with_the_rule_that_helps() -> None:
    problem = camera("2-1", address=99).permission_problem()
    assert problem is not None
    assert "/dev/bus/usb/002/099" in problem
    assert UDEV_RULES.splitlines()[1] in problem
    assert 'ATTR{idVendor}=="0403", ATTR{idProduct}=="601f"' in problem


def test_the_rules_to_deploy_are_the_rules_that_messages_name() -> None:
    lines = [line for line in DEPLOYED.read_text().splitlines() if line and not line.startswith("#")]
    assert lines == UDEV_RULES.splitlines()


@pytest.mark.parametrize(
    ("text", "choice"),
    [
        ("usb0", CameraChoice(number=0)),
        ("usb12", CameraChoice(number=12)),
        ("usb:2-1.4", CameraChoice(port="2-1.4")),
        ("usb:000000000001", CameraChoice(serial=FACTORY)),
        ("usb:2-1.4x", CameraChoice(serial="2-1.4x")),
    ],
)
def test_a_camera_is_named_by_number_port_or_serial(text: str, choice: CameraChoice) -> None:
    assert CameraChoice.parse(text) == choice
    assert str(choice) == text


@pytest.mark.parametrize("text", ["usb", "usb:", "sim:", ""])
def test_other_names_are_refused(text: str) -> None:
    with pytest.raises(SourceError, match="names no USB camera"):
        CameraChoice.parse(text)


def test_the_camera_that_is_meant() -> None:
    cameras = [camera("2-1"), camera("2-2", "17"), camera("2-3")]
    assert CameraChoice(number=1).pick(cameras) is cameras[1]
    assert CameraChoice(number=3).pick(cameras) is None
    assert CameraChoice(port="2-3").pick(cameras) is cameras[2]
    assert CameraChoice(port="2-4").pick(cameras) is None
    assert CameraChoice(serial="17").pick(cameras) is cameras[1]
    with pytest.raises(NotUsableError, match=r"not unique: name yours by its port, one of usb:2-1, usb:2-3"):
        CameraChoice(serial=FACTORY).pick(cameras)


def test_a_lost_camera_is_found_again_and_no_other_is_taken_for_it() -> None:
    lost, other = camera("2-1"), camera("2-2")
    first = CameraChoice(number=0)
    others = {"2-2"}
    assert first.find_again([other], lost, others) is None
    back = camera("2-1", address=9)
    assert first.find_again([back, other], lost, others) is back
    elsewhere = camera("3-1")
    assert first.find_again([other, elsewhere], lost, others) is elsewhere
    assert first.find_again([other, camera("3-1", serial="another")], lost, others) is None
    assert CameraChoice(port="2-1").find_again([other, elsewhere], lost, others) is None


def test_a_node_that_may_be_read_is_no_problem(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "access", lambda path, mode: str(path) == "/dev/bus/usb/002/007")
    assert camera("2-1").permission_problem() is None
