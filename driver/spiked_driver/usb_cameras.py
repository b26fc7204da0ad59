"""Lists USB cameras, selects one, and checks whether it can be used. Reads sysfs and opens no device.

sysfs also shows cameras that this user may not open, and cameras on slow ports, with their serial numbers.
"""

import os
import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

from spiked.errors import SourceError
from spiked_driver.ft60x import PRODUCTS, VENDOR_ID

SYSFS = Path("/sys/bus/usb/devices")
USB3_MBPS = 5000
"""Least link speed of USB 3, Mbit/s."""
UDEV_FILE = "/etc/udev/rules.d/70-spiked.rules"
UDEV_RULES = "\n".join(
    f'SUBSYSTEM=="usb", ATTR{{idVendor}}=="{VENDOR_ID:04x}", ATTR{{idProduct}}=="{product:04x}", '
    'MODE="0660", GROUP="plugdev", TAG+="uaccess", ATTR{power/control}="on"'
    for product in PRODUCTS
)
"""Access for the user at the machine (uaccess) and the group plugdev (a daemon's user); no power saving."""

_PORT = re.compile(r"\d+-\d+(\.\d+)*")
_SPEEDS = {1.5: "USB 1, 1.5 Mbit/s", 12: "USB 1, 12 Mbit/s", 480: "USB 2, 480 Mbit/s"}


class NotUsableError(SourceError):
    """The camera is plugged in and cannot be used for a reason that the user can fix."""


@dataclass(frozen=True)
class UsbCamera:
    """A camera that is plugged in."""

    port: str
    """Bus and port path in the kernel's notation: `2-1.4` is port 4 of the hub in port 1 of bus 2."""
    bus: int
    address: int
    """Number on the bus; changes each time that the camera is plugged in."""
    product_id: int
    serial: str | None
    """Not unique: FTDI's factory serial number is the same on many cameras."""
    speed_mbps: float | None
    firmware: str | None
    """Release number in the bridge's descriptor, as `1.06`."""

    @property
    def chip(self) -> str:
        """The bridge: FT600 or FT601."""
        return PRODUCTS[self.product_id]

    @property
    def node(self) -> Path:
        """Its device node."""
        return Path(f"/dev/bus/usb/{self.bus:03d}/{self.address:03d}")

    @property
    def speed(self) -> str:
        """Speed of its link, as shown to users."""
        if self.speed_mbps is None:
            return "unknown speed"
        if self.speed_mbps < USB3_MBPS:
            return _SPEEDS.get(self.speed_mbps, f"{self.speed_mbps:g} Mbit/s")
        return f"USB 3, {self.speed_mbps / 1000:g} Gbit/s"

    def speed_problem(self) -> str | None:
        """Why its port is too slow, and what to do; None if it is not."""
        if self.speed_mbps is None or self.speed_mbps >= USB3_MBPS:
            return None
        return (
            f"the camera at {self.port} is connected by {self.speed}, and needs USB 3 (5 Gbit/s): "
            "plug it into a USB 3 port (blue, or marked SS), with a USB 3 cable and no USB 2 hub between"
        )

    def permission_problem(self) -> str | None:
        """Why this user may not open it, and the udev rule to add; None if it may be opened."""
        if os.access(self.node, os.R_OK | os.W_OK):
            return None
        return (
            f"this user may not open the camera at {self.port} ({self.node}): write into {UDEV_FILE} the line "
            f"{_rule(self.product_id)} "
            "(`spiked devices --udev-rules` prints it), run `sudo udevadm control --reload && sudo udevadm trigger`, "
            "and join the group plugdev or plug the camera in again"
        )


def _rule(product: int) -> str:
    return UDEV_RULES.splitlines()[list(PRODUCTS).index(product)]


def find_cameras() -> list[UsbCamera]:
    """All cameras that are plugged in, ordered by bus and port."""
    try:
        folders = list(SYSFS.iterdir())
    except OSError:
        return []  # no USB on this machine, or none visible in this container
    found = [camera for folder in folders if _PORT.fullmatch(folder.name) and (camera := _read(folder))]
    return sorted(found, key=lambda camera: [int(number) for number in re.findall(r"\d+", camera.port)])


def _read(folder: Path) -> UsbCamera | None:
    """The camera of a sysfs folder; None if it is another device, or was unplugged meanwhile."""
    try:
        vendor, product = (int((folder / name).read_text(), 16) for name in ("idVendor", "idProduct"))
        if vendor != VENDOR_ID or product not in PRODUCTS:
            return None
        bus, address = (int((folder / name).read_text()) for name in ("busnum", "devnum"))
    except (OSError, ValueError):
        return None
    speed, release = _optional(folder / "speed"), _optional(folder / "bcdDevice")
    return UsbCamera(
        port=folder.name,
        bus=bus,
        address=address,
        product_id=product,
        serial=_optional(folder / "serial"),
        speed_mbps=float(speed) if speed and speed.replace(".", "", 1).isdigit() else None,
        firmware=f"{int(release[:2], 16):x}.{release[2:4]}" if release and len(release) == 4 else None,
    )


def _optional(file: Path) -> str | None:
    try:
        return file.read_text(errors="replace").strip() or None
    except OSError:
        return None


@dataclass(frozen=True)
class CameraChoice:
    """The camera that a user names by one of `number` (in order of bus and port), `port` and `serial`."""

    number: int | None = None
    port: str | None = None
    serial: str | None = None

    @classmethod
    def parse(cls, text: str) -> "CameraChoice":
        """From `usb0`, `usb:2-1.4` or `usb:SERIAL`. Raises SourceError."""
        if re.fullmatch(r"usb\d+", text):
            return cls(number=int(text[3:]))
        kind, _, rest = text.partition(":")
        if kind != "usb" or not rest:
            raise SourceError(
                f"{text!r} names no USB camera: write usb0 for the first one, usb:BUS-PORT (as usb:2-1.4) or usb:SERIAL"
            )
        return cls(port=rest) if _PORT.fullmatch(rest) else cls(serial=rest)

    def __str__(self) -> str:
        return f"usb{self.number}" if self.number is not None else f"usb:{self.port or self.serial}"

    def pick(self, cameras: Sequence[UsbCamera]) -> UsbCamera | None:
        """The named camera; None if it is not plugged in. Raises NotUsableError if several have the serial number."""
        if self.number is not None:
            return cameras[self.number] if self.number < len(cameras) else None
        fitting = [camera for camera in cameras if self.serial in (None, camera.serial)]
        fitting = [camera for camera in fitting if self.port in (None, camera.port)]
        if len(fitting) > 1:
            ports = ", ".join(f"usb:{camera.port}" for camera in fitting)
            raise NotUsableError(
                f"{len(fitting)} cameras have the serial number {self.serial}, which is not unique: "
                f"name yours by its port, one of {ports}"
            )
        return fitting[0] if fitting else None

    def find_again(self, cameras: Sequence[UsbCamera], lost: UsbCamera, others: Collection[str]) -> UsbCamera | None:
        """The camera that replaces `lost`: one at the same port, else one with its serial number at a new port.

        `others` are the ports of the cameras that were plugged in beside it; those are never returned. A choice by port
        keeps the port, a choice by serial number keeps the number.
        """
        for camera in cameras:
            same_serial = self.serial in (None, camera.serial)
            if camera.port == lost.port and camera.product_id == lost.product_id and same_serial:
                return camera
        if self.port is not None:
            return None
        newcomers = [camera for camera in cameras if camera.port not in others and camera.serial == lost.serial]
        return newcomers[0] if newcomers else None
