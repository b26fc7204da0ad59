"""The doctor finds what is wrong with a machine and says what to do; a fit one passes."""

from pathlib import Path

import pytest
from spiked_driver import usb_budget, usb_cameras
from spiked_driver.source_kinds import known_devices
from spiked_service.operations import doctor
from spiked_service.operations.doctor import Diagnosis, DiagnosisStatus, examine
from spiked_service.store.folder import Space

from spiked.ring import DeviceState


class Machine:
    """Files that the doctor reads, below a folder."""

    def __init__(self, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.root = root
        monkeypatch.setattr(usb_cameras, "SYSFS", root / "usb")
        for module in (usb_budget, doctor):
            monkeypatch.setattr(module, "LIMIT_FILE", root / "usbfs_memory_mb")
        monkeypatch.setattr(doctor, "CPU", root / "cpu")
        monkeypatch.setattr(doctor, "UDEV_FOLDERS", (root / "etc",))
        monkeypatch.setattr(doctor, "PROBE_BYTES", 4 << 20)
        (root / "usb").mkdir()

    def plug(self, port: str, speed: str = "5000") -> None:
        folder = self.root / "usb" / port
        folder.mkdir()
        values = {"idVendor": "0403", "idProduct": "601f", "busnum": port[0], "devnum": "9", "speed": speed}
        for name, value in {**values, "serial": "000000000001"}.items():
            (folder / name).write_text(value + "\n")

    def write(self, file: str, text: str) -> None:
        path = self.root / file
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)

    def examine(self) -> dict[str, Diagnosis]:
        return {finding.name: finding for finding in examine(self.root / "data" / "not" / "there")}


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Machine:
    return Machine(tmp_path, monkeypatch)


def test_what_is_not_fit_is_named_with_what_to_do(machine: Machine) -> None:
    machine.plug("1-2", speed="480")
    machine.plug("2-1")
    machine.write("usbfs_memory_mb", "16\n")
    machine.write("cpu/cpu0/cpufreq/scaling_governor", "powersave\n")
    found = machine.examine()
    assert found["cameras"].finding == "2 plugged in: 1-2, 2-1"
    slow, closed = found["camera 1-2"], found["camera 2-1"]
    assert (slow.status, closed.status) == (DiagnosisStatus.PROBLEM, DiagnosisStatus.PROBLEM)
    assert "USB 2, 480 Mbit/s" in slow.finding and "USB 3 port" in (slow.what_to_do or "")
    assert "may not open" in closed.finding and 'SUBSYSTEM=="usb"' in (closed.what_to_do or "")
    assert found["usbfs memory"].status is DiagnosisStatus.WARNING
    assert "16 MiB for all cameras" in found["usbfs memory"].finding
    assert "usbfs_memory_mb=" in (found["usbfs memory"].what_to_do or "")
    assert found["CPU governor"].status is DiagnosisStatus.WARNING
    assert "performance" in (found["CPU governor"].what_to_do or "")


def test_two_cameras_on_one_bus_do_not_fit(machine: Machine) -> None:
    machine.plug("2-1")
    assert "bus" not in machine.examine()
    machine.plug("2-2")
    assert "2-1, 2-2 share bus 2" in machine.examine()["bus"].finding


def test_a_fit_machine_has_no_problem(machine: Machine, monkeypatch: pytest.MonkeyPatch) -> None:
    machine.plug("2-1")
    machine.write("usbfs_memory_mb", "1000\n")
    machine.write("cpu/cpu0/cpufreq/scaling_governor", "performance\n")
    machine.write("etc/udev/rules.d/70-spiked.rules", usb_cameras.UDEV_RULES)
    monkeypatch.setattr(usb_cameras.os, "access", lambda path, mode: True)
    found = machine.examine()
    for name in ("cameras", "camera 2-1", "udev rule", "usbfs memory", "CPU governor"):
        assert found[name].status is DiagnosisStatus.OK, found[name]
    assert found["udev rule"].finding.endswith("70-spiked.rules")


@pytest.mark.parametrize(("root", "status"), [(0, DiagnosisStatus.OK), (1000, DiagnosisStatus.WARNING)])
def test_rules_are_for_those_who_are_not_root(
    machine: Machine, monkeypatch: pytest.MonkeyPatch, root: int, status: DiagnosisStatus
) -> None:
    monkeypatch.setattr(doctor.os, "geteuid", lambda: root)
    machine.write("etc/udev/rules.d/50-other.rules", 'ATTR{idVendor}=="0403", ATTR{idProduct}=="6001"')
    assert machine.examine()["udev rule"].status is status


@pytest.mark.parametrize(
    ("speed", "free", "names"),
    [
        (100e6, 1e12, {"disk speed"}),
        (1e9, 10e9, {"disk space"}),
        (1e9, 1e12, set()),
    ],
)
def test_a_disk_that_is_slow_or_full_is_told(
    machine: Machine, monkeypatch: pytest.MonkeyPatch, speed: float, free: float, names: set[str]
) -> None:
    monkeypatch.setattr(doctor, "space_at", lambda folder: Space(int(free), int(2 * free)))
    monkeypatch.setattr(doctor, "written_bytes_a_second", lambda folder: speed)
    found = machine.examine()
    assert {name for name in ("disk space", "disk speed") if found[name].status is not DiagnosisStatus.OK} == names


def test_the_disk_is_really_written_and_left_as_it_was(machine: Machine) -> None:
    found = machine.examine()["disk speed"]
    assert "MB/s written and flushed" in found.finding
    assert sorted(path.name for path in machine.root.iterdir()) == ["usb"]


def test_little_shared_memory_is_a_problem(machine: Machine, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = doctor.shutil.disk_usage(machine.root)._replace(free=64 << 20)
    monkeypatch.setattr(doctor.shutil, "disk_usage", lambda folder: usage)
    monkeypatch.setattr(doctor, "disk_findings", lambda data, running: [])
    assert machine.examine()["shared memory"].status is DiagnosisStatus.PROBLEM


def test_devices_are_the_configured_ones_the_plugged_ones_and_what_is_always_there(machine: Machine) -> None:
    machine.plug("2-1")
    machine.plug("1-2", speed="480")
    devices = {device.source: device for device in known_devices(["usb:2-1?fov=40", "usb7", "replay:a.dat"])}
    assert list(devices) == ["usb:2-1?fov=40", "usb7", "replay:a.dat", "usb:1-2", "sim:"]
    named, missing, slow = devices["usb:2-1?fov=40"], devices["usb7"], devices["usb:1-2"]
    assert (named.kind, named.port, named.serial, named.speed) == ("usb", "2-1", "000000000001", "USB 3, 5 Gbit/s")
    assert named.state is DeviceState.IDLE
    assert missing.state is DeviceState.ABSENT
    assert "plug it in" in missing.reason
    assert "needs USB 3" in slow.reason
    assert str(named.capabilities["exposure"]) == "not supported"
    assert str(named.capabilities["resolution"]) == "400x250"


def test_a_serial_that_two_cameras_have_is_told(machine: Machine) -> None:
    machine.plug("2-1")
    machine.plug("2-2")
    assert "not unique" in known_devices(["usb:000000000001"])[0].reason
