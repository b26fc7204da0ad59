"""What any program can do with the camera: plain pyusb and bare ioctls. Runs in a process that sees the mocked machine.

`python -m plain_client FUNCTION JSON-ARGUMENTS` prints the function's result as JSON.
"""

import array
import ctypes
import errno
import json
import os
import select
import struct
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import usb.backend.libusb0
import usb.backend.libusb1
import usb.backend.openusb
import usb.core
import usb.util

READ_BYTES = 1 << 16
VENDOR, PRODUCT = 0x0403, 0x601F


def devices() -> list[dict[str, Any]]:
    """What is plugged in, hubs left out."""
    found = usb.core.find(find_all=True, idVendor=VENDOR)
    return [
        {
            "product": device.idProduct,
            "bus": device.bus,
            "ports": list(device.port_numbers),
            "speed": device.speed,
            "serial": device.serial_number,
            "name": device.product,
        }
        for device in found
    ]


def chip_configuration() -> str:
    """The answer to vendor request 0xCF."""
    return bytes(_open().ctrl_transfer(0xC0, 0xCF, 1, 0, 152)).hex()


def read(path: str, count: int, *, ask: bool = True, timeout_ms: int = 2000) -> dict[str, Any]:
    """Read `count` times into a file; lengths of the reads, and the errno that ended it before, if any."""
    device = _open()
    lengths: list[int] = []
    failed: int | None = None
    with Path(path).open("wb") as out:
        for index in range(count):
            try:
                lengths.append(_read(device, out.write, index if ask else None, timeout_ms))
            except usb.core.USBError as error:
                failed = error.errno
                break
    return {"lengths": lengths, "errno": failed}


def read_through_stalls(path: str, count: int) -> dict[str, Any]:
    """As `read`, but a halted endpoint is cleared, and other errors are passed over, as long as the device is there."""
    device = _open()
    errors: list[int] = []
    reads = 0
    with Path(path).open("wb") as out:
        while reads < count and len(errors) < 20:
            try:
                _read(device, out.write, reads, 500)
                reads += 1
            except usb.core.USBError as error:
                errors.append(error.errno or 0)
                if error.errno == errno.EPIPE:
                    device.clear_halt(0x82)
                elif error.errno in (errno.ENODEV, errno.EIO):
                    break
    return {"errors": errors, "reads": reads}


def refused() -> int | None:
    """The errno of opening the device, None if it opens."""
    device = usb.core.find(idVendor=VENDOR, idProduct=PRODUCT)
    try:
        usb.util.claim_interface(device, 0)
    except usb.core.USBError as error:
        return error.errno
    return None


def submit_until_refused(length: int) -> tuple[int, int]:
    """Transfers that usbfs takes before it refuses one, and with which errno. Bare ioctls, no libusb."""
    node = os.open(sorted(Path("/dev/bus/usb/002").iterdir())[-1], os.O_RDWR)
    urbs: list[Any] = []
    try:
        while True:
            urbs.append(_Urb(3, 0x82, length))
            _ioctl(node, 0x8038550A, urbs[-1].address)
    except OSError as error:
        return len(urbs) - 1, error.errno


def poll_and_discard() -> dict[str, Any]:
    """Nothing was asked for: poll is silent until the transfer is discarded, which gives it back empty."""
    node = os.open(sorted(Path("/dev/bus/usb/002").iterdir())[-1], os.O_RDWR)
    poll = select.poll()
    poll.register(node, select.POLLOUT)
    urb = _Urb(3, 0x82, 1024)
    _ioctl(node, 0x8038550A, urb.address)
    before = len(poll.poll(50))
    _ioctl(node, 0x0000550B, urb.address)
    after = len(poll.poll(5000))
    reaped = ctypes.c_uint64()
    _ioctl(node, 0x4008550D, ctypes.addressof(reaped))
    status, actual = struct.unpack_from("@i", urb.raw, 4)[0], struct.unpack_from("@i", urb.raw, 28)[0]
    return {
        "ready": [before, after, len(poll.poll(0))],
        "same": reaped.value == urb.address,
        "status": status,
        "actual": actual,
    }


def _ioctl(node: int, request: int, argument: int) -> None:
    if ctypes.CDLL(None, use_errno=True).ioctl(node, ctypes.c_ulong(request), ctypes.c_void_p(argument)) < 0:
        raise OSError(ctypes.get_errno(), f"ioctl {request:#x}")


class _Urb:
    """struct usbdevfs_urb with a buffer."""

    def __init__(self, kind: int, endpoint: int, length: int) -> None:
        self.buffer = ctypes.create_string_buffer(length)
        layout = struct.pack(
            "@BBxxiIxxxxQiiiiiIQ", kind, endpoint, 0, 0, ctypes.addressof(self.buffer), length, 0, 0, 0, 0, 0, 0
        )
        self.raw = ctypes.create_string_buffer(layout, len(layout))
        self.address = ctypes.addressof(self.raw)


def _open() -> Any:
    device = usb.core.find(idVendor=VENDOR, idProduct=PRODUCT)
    if device is None:
        raise SystemExit("no camera")
    usb.util.claim_interface(device, 0)
    usb.util.claim_interface(device, 1)
    return device


def _read(device: Any, write: Callable[[bytes], Any], index: int | None, timeout_ms: int) -> int:
    if index is not None:
        device.write(0x01, struct.pack("<IBBHIII", index, 0x82, 1, 0, READ_BYTES, 0, 0))
    buffer = array.array("B", bytes(READ_BYTES))
    length = int(device.read(0x82, buffer, timeout_ms))
    write(buffer[:length].tobytes())
    return length


if __name__ == "__main__":
    function, arguments = sys.argv[1], json.loads(sys.argv[2])
    if arguments["user"] is not None:
        usb.backend.libusb1.get_backend()  # nobody may not look for libraries everywhere, nor for modules
        os.setuid(arguments["user"])
    print(json.dumps(globals()[function](*arguments["args"], **arguments["kwargs"])))
