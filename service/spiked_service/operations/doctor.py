"""Whether this machine is fit for a USB camera: each thing looked at by itself, with what was found and what to do."""

import os
import re
import shutil
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from spiked_driver.framing import USB_FRAME_BYTES
from spiked_driver.ft60x import PRODUCTS, VENDOR_ID
from spiked_driver.realtime import PRIORITY, may_lock_memory, may_schedule
from spiked_driver.source_kind import RATE_HZ
from spiked_driver.usb_budget import LIMIT_FILE, how_to_raise, kernel_bytes, plan_transfers, usbfs_limit
from spiked_driver.usb_cameras import UDEV_FILE, UsbCamera, find_cameras
from spiked_driver.usb_session import bridge_configuration

from spiked.errors import ConfigurationError, SourceError
from spiked.render.choice import chosen
from spiked.ring.segment import FOLDER as RING_FOLDER
from spiked.ring.writer import DEFAULT_BYTES, MOST_BACKLOG_BYTES
from spiked.sensor import Sensor
from spiked_service.operations.disk_forecast import disk_forecast
from spiked_service.store.folder import nearest_folder, space_at

UDEV_FOLDERS = tuple(Path(folder) for folder in ("/etc", "/run", "/usr/lib", "/lib", "/usr/local/lib"))
CPU = Path("/sys/devices/system/cpu")
_WIRE_S = USB_FRAME_BYTES * RATE_HZ
_BUS_S = 400e6
"""What is left of 5 Gbit/s after encoding and protocol, about."""
_MINUTES = 5
"""Length of the recording that the disk should hold, minutes."""
PROBE_BYTES = 128 << 20
"""Written to measure the speed of the disk."""
_PIECE = bytes(range(256)) * (4 << 10)
"""One write of the probe, 1 MiB."""


class DiagnosisStatus(StrEnum):
    """How bad it is."""

    OK = "ok"
    WARNING = "warning"
    """It works, with losses or for a short time."""
    PROBLEM = "problem"
    """A camera cannot be used."""


@dataclass(frozen=True)
class Diagnosis:
    """One thing that was looked at."""

    name: str
    status: DiagnosisStatus
    finding: str
    what_to_do: str | None = None


def examine(data: Path, running: Sequence[Sensor] = ()) -> list[Diagnosis]:
    """All that matters; takes about a second for the disk below the data folder. Changes nothing.

    `running` are the sensors of the cameras that record now.
    """
    cameras = find_cameras()
    return [
        _cameras(cameras),
        *(finding for camera in cameras for finding in _camera(camera)),
        *_shared_buses(cameras),
        _udev_rule(),
        _usbfs(max(1, len(cameras))),
        _governor(),
        _priority(),
        _memory(),
        _shared_memory(),
        *disk_findings(data, running),
        _renderer(),
    ]


def memory_findings() -> list[Diagnosis]:
    """Shared memory and renderer, which every service uses, with or without a camera."""
    return [_shared_memory(), _renderer()]


def _cameras(cameras: list[UsbCamera]) -> Diagnosis:
    name = "cameras"
    if cameras:
        return Diagnosis(
            name, DiagnosisStatus.OK, f"{len(cameras)} plugged in: {', '.join(camera.port for camera in cameras)}"
        )
    ids = " or ".join(f"{VENDOR_ID:04x}:{product:04x}" for product in PRODUCTS)
    todo = f"plug it in, power it, and look with `lsusb -d {VENDOR_ID:04x}:` whether the kernel sees {ids}"
    return Diagnosis(name, DiagnosisStatus.WARNING, "no USB camera is plugged in", todo)


def _camera(camera: UsbCamera) -> Iterator[Diagnosis]:
    """Port speed and permission of one; if they are good, the configuration of its bridge too."""
    name = f"camera {camera.port}"
    problems = [problem for problem in (camera.speed_problem(), camera.permission_problem()) if problem]
    if problems:
        found, _, todo = problems[0].partition(": ")
        yield Diagnosis(name, DiagnosisStatus.PROBLEM, found, todo)
        return
    yield Diagnosis(name, DiagnosisStatus.OK, f"{camera.speed}, and may be opened")
    yield _bridge(camera)


def _bridge(camera: UsbCamera) -> Diagnosis:
    """FIFO mode, clock and channels, as the chip has them stored."""
    name = f"bridge {camera.port}"
    try:
        chip = bridge_configuration(camera)
    except SourceError as error:
        return Diagnosis(
            name, DiagnosisStatus.WARNING, str(error), "plug the camera in again; if that stays, is it an FT601?"
        )
    for status, problem in (
        (DiagnosisStatus.PROBLEM, chip.impossible(_WIRE_S)),
        (DiagnosisStatus.WARNING, chip.unusual()),
    ):
        if problem:
            found, _, todo = problem.partition(": ")
            return Diagnosis(name, status, f"{chip}: {found}", todo)
    return Diagnosis(name, DiagnosisStatus.OK, f"{camera.chip}: {chip}")


def _shared_buses(cameras: list[UsbCamera]) -> Iterator[Diagnosis]:
    for bus in sorted({camera.bus for camera in cameras}):
        here = [camera for camera in cameras if camera.bus == bus]
        slowest = min((camera.speed_mbps or 5000) / 5000 * _BUS_S for camera in here)
        if len(here) * _WIRE_S > slowest:
            ports = ", ".join(camera.port for camera in here)
            found = (
                f"{ports} share bus {bus}, which carries about {slowest / 1e6:.0f} MB/s; each needs {_WIRE_S / 1e6:.0f}"
            )
            yield Diagnosis(
                "bus", DiagnosisStatus.WARNING, found, "give each camera a controller of its own (see `lsusb -t`)"
            )


def _udev_rule() -> Diagnosis:
    name = "udev rule"
    for file in _udev_files():
        try:
            text = file.read_text(errors="replace").lower()
        except OSError:
            continue
        if all(re.search(f'"{number:04x}"', text) for number in (VENDOR_ID, *PRODUCTS)):
            return Diagnosis(name, DiagnosisStatus.OK, f"{file}")
    if os.geteuid() == 0:
        return Diagnosis(name, DiagnosisStatus.OK, "none, and none is needed by root")
    todo = f"spiked devices --udev-rules | sudo tee {UDEV_FILE}; sudo udevadm control --reload; sudo udevadm trigger"
    return Diagnosis(name, DiagnosisStatus.WARNING, "no rule lets ordinary users open the camera", todo)


def _udev_files() -> Iterable[Path]:
    for folder in UDEV_FOLDERS:
        yield from sorted((folder / "udev/rules.d").glob("*.rules"))


def _usbfs(cameras: int) -> Diagnosis:
    """The budget of all plugged cameras together."""
    name = "usbfs memory"
    limit = usbfs_limit()
    wanted = plan_transfers(_WIRE_S, None)
    needed = cameras * kernel_bytes(wanted.count, wanted.transfer_bytes)
    if limit is None:
        none = "no limit" if LIMIT_FILE.exists() else f"no limit is to be seen: there is no {LIMIT_FILE}"
        return Diagnosis(name, DiagnosisStatus.OK, none)
    found = f"{limit >> 20} MiB for all cameras, {needed / 2**20:.0f} MiB are wanted"
    if needed <= limit:
        return Diagnosis(name, DiagnosisStatus.OK, found)
    try:
        buffered_ms = 1e3 * plan_transfers(_WIRE_S, limit // cameras).buffered_s
    except SourceError:
        return Diagnosis(name, DiagnosisStatus.PROBLEM, found, how_to_raise(needed))
    hidden = f"{found}: a busy host loses frames after {buffered_ms:.0f} ms, not {1e3 * wanted.buffered_s:.0f}"
    return Diagnosis(name, DiagnosisStatus.WARNING, hidden, how_to_raise(needed))


def _governor() -> Diagnosis:
    name = "CPU governor"
    files = sorted(CPU.glob("cpu[0-9]*/cpufreq/scaling_governor"))
    governors = sorted({file.read_text().strip() for file in files})
    if not governors:
        return Diagnosis(name, DiagnosisStatus.OK, "the kernel does not change the clock here")
    found = ", ".join(governors)
    if governors == ["performance"]:
        return Diagnosis(name, DiagnosisStatus.OK, found)
    todo = (
        "sudo cpupower frequency-set -g performance (or: echo performance | sudo tee "
        f"{CPU}/cpu*/cpufreq/scaling_governor)"
    )
    return Diagnosis(name, DiagnosisStatus.WARNING, f"{found}: a core that has slowed down may lose frames", todo)


def _priority() -> Diagnosis:
    if may_schedule():
        return Diagnosis("real-time priority", DiagnosisStatus.OK, "permitted")
    todo = f"LimitRTPRIO={PRIORITY} in the systemd unit, or a line `USER - rtprio {PRIORITY}` in /etc/security/limits.d"
    return Diagnosis(
        "real-time priority", DiagnosisStatus.WARNING, "not permitted: other programs may delay acquisition", todo
    )


def _memory() -> Diagnosis:
    if may_lock_memory():
        return Diagnosis("locked memory", DiagnosisStatus.OK, "permitted")
    todo = "LimitMEMLOCK=infinity in the systemd unit, or a line `USER - memlock unlimited` in /etc/security/limits.d"
    return Diagnosis(
        "locked memory", DiagnosisStatus.WARNING, "not permitted: acquisition's memory may be paged out", todo
    )


def _shared_memory() -> Diagnosis:
    name = "shared memory"
    if not os.access(RING_FOLDER, os.W_OK | os.X_OK):
        todo = f"sudo mount -t tmpfs -o mode=1777,size=1G tmpfs {RING_FOLDER}; in a chroot, bind the host's"
        return Diagnosis(name, DiagnosisStatus.PROBLEM, f"{RING_FOLDER} cannot be written by this user", todo)
    free = shutil.disk_usage(RING_FOLDER).free
    takes = f"{DEFAULT_BYTES >> 20} MiB, and up to {MOST_BACKLOG_BYTES >> 20} to reconstruct meanwhile"
    found = f"{free >> 20} MiB free in {RING_FOLDER}, a capture takes {takes}"
    if free > 1.1 * DEFAULT_BYTES:
        return Diagnosis(name, DiagnosisStatus.OK, found)
    todo = f"sudo mount -o remount,size=1G {RING_FOLDER} (a container has an option for it, as --shm-size)"
    return Diagnosis(name, DiagnosisStatus.PROBLEM, found, todo)


def _renderer() -> Diagnosis:
    """What maps are rendered with."""
    name = "renderer"
    try:
        choice = chosen()
    except ConfigurationError as error:
        return Diagnosis(name, DiagnosisStatus.PROBLEM, str(error), "unset SPIKED_RENDER, or set it to cpu")
    if choice.unused:
        todo = "mend that, or set SPIKED_RENDER=cpu to render without the GPU"
        return Diagnosis(name, DiagnosisStatus.WARNING, f"{choice.renderer}: {choice.reason}", todo)
    return Diagnosis(name, DiagnosisStatus.OK, f"{choice.renderer}: {choice.reason}")


def disk_findings(data: Path, running: Sequence[Sensor] = ()) -> Iterator[Diagnosis]:
    """Free space and measured write speed of the disk below the data folder."""
    folder = nearest_folder(data)
    space = space_at(folder)
    free, forecast = space.free_bytes, disk_forecast(space, running)
    found = f"{free / 1e9:.0f} GB free in {folder}, {forecast.seconds / 60:.0f} minutes of {forecast.of}"
    if forecast.seconds >= 60 * _MINUTES:
        yield Diagnosis("disk space", DiagnosisStatus.OK, found)
    else:
        yield Diagnosis(
            "disk space", DiagnosisStatus.WARNING, found, "remove recordings, or give another folder with --data"
        )
    if free < 2 * PROBE_BYTES:
        yield Diagnosis(
            "disk speed", DiagnosisStatus.WARNING, "not measured: there is no room to try", "make room on the disk"
        )
        return
    try:
        speed = written_bytes_a_second(folder)
    except OSError as error:
        todo = "give a folder with --data that this user may write"
        yield Diagnosis("disk speed", DiagnosisStatus.PROBLEM, f"{folder} cannot be written: {error.strerror}", todo)
        return
    found = f"{speed / 1e6:.0f} MB/s written and flushed; recording takes {forecast.bytes_s / 1e6:.0f}"
    if speed > 1.2 * forecast.bytes_s:
        yield Diagnosis("disk speed", DiagnosisStatus.OK, found)
    else:
        todo = "record to a faster disk (--data), or shorter than memory holds"
        yield Diagnosis("disk speed", DiagnosisStatus.WARNING, found, todo)


def written_bytes_a_second(folder: Path) -> float:
    """Write `PROBE_BYTES` to an unnamed file in the folder, flush them to the disk, and return bytes per second."""
    with tempfile.TemporaryFile(dir=folder, buffering=0) as file:
        start_s = time.monotonic()
        for _ in range(PROBE_BYTES // len(_PIECE)):
            file.write(_PIECE)
        os.fdatasync(file.fileno())
        return PROBE_BYTES / (time.monotonic() - start_s)
