"""A mocked /sys and /dev with USB 2 and USB 3 root hubs, by libumockdev."""

import ctypes
import os
import socket
from pathlib import Path

from .core import Camera
from .descriptors import Speed

PRELOAD = "libumockdev-preload.so.0"
_CONTROLLER = "/devices/pci0000:00/0000:00:14.0"
_HUB = bytes.fromhex(
    "120100030900030900040000000600000001"  # device
    "09021f00010100e000 0904000001090000 00 070581030400 0c 063000000200"  # configuration, SuperSpeed
)


class Testbed:
    """One machine's USB as libusb and udev see it. Device nodes are FIFOs, each with a socket for its ioctls."""

    __test__ = False  # not a test, whatever its name

    def __init__(self, usbfs_memory_mb: int) -> None:
        self._library = ctypes.CDLL("libumockdev.so.0")
        self._library.umockdev_testbed_new.restype = ctypes.c_void_p
        self._library.umockdev_testbed_get_root_dir.restype = ctypes.c_char_p
        self._handle = ctypes.c_void_p(self._library.umockdev_testbed_new())
        self.root = Path(os.fsdecode(self._library.umockdev_testbed_get_root_dir(self._handle)))
        self.root.chmod(0o755)
        self._devices = dict.fromkeys((1, 2), 1)
        """The last device number of each bus."""
        parameters = self.root / "sys/module/usbcore/parameters"
        parameters.mkdir(parents=True)
        (parameters / "usbfs_memory_mb").write_text(f"{usbfs_memory_mb}\n")
        self._hubs: set[str] = set()
        for bus, speed in ((1, Speed.HIGH), (2, Speed.SUPER)):
            self._add(f"{_CONTROLLER}/usb{bus}", bus, 1, speed, _HUB, {})

    def plug(self, camera: Camera, port: str, mode: int) -> tuple[str, Path, socket.socket]:
        """A camera comes: its name in sysfs, its FIFO, and the socket where ioctls arrive; then udev is told.

        `port` is as in sysfs, `2-1.3`: bus, and the ports from the root hub on. `mode` are the node's permissions.
        """
        bus = int(port.partition("-")[0])
        parent = f"{_CONTROLLER}/usb{bus}"
        for depth in range(port.count(".")):
            hub = ".".join(port.split(".")[: depth + 1])
            parent += f"/{hub}"
            if hub not in self._hubs:
                self._hubs.add(hub)
                self._add(parent, bus, self._number(bus), camera.speed, _HUB, {})
        number = self._number(bus)
        node = f"bus/usb/{bus:03}/{number:03}"
        listener = socket.socket(socket.AF_UNIX)
        address = self.root / "ioctl/dev" / node
        address.parent.mkdir(parents=True, exist_ok=True)
        address.unlink(missing_ok=True)
        listener.bind(str(address))
        address.chmod(0o777)
        listener.listen()
        identity = camera.identity
        texts = {"manufacturer": identity.manufacturer, "product": identity.name, "serial": identity.serial}
        fifo = self.root / "dev" / node
        fifo.parent.mkdir(parents=True, exist_ok=True)
        fifo.unlink(missing_ok=True)
        os.mkfifo(fifo)
        fifo.chmod(mode)
        self._add(f"{parent}/{port}", bus, number, camera.speed, camera.descriptors, texts)
        return f"/sys{parent}/{port}", fifo, listener

    def _number(self, bus: int) -> int:
        """A new device's number."""
        self._devices[bus] = self._devices[bus] % 127 + 1
        return self._devices[bus]

    def unplug(self, syspath: str, fifo: Path) -> None:
        """A camera goes, and udev is told."""
        path = os.fsencode(syspath)
        fifo.unlink()
        (self.root / "ioctl" / fifo.relative_to(self.root)).unlink()
        self._library.umockdev_testbed_uevent(self._handle, path, b"remove")
        self._library.umockdev_testbed_remove_device(self._handle, path)

    def _add(
        self, devpath: str, bus: int, number: int, speed: Speed, descriptors: bytes, texts: dict[str, str]
    ) -> None:
        """Describe a device in umockdev's format. It makes no node: that is there already."""
        identity = {"idVendor": descriptors[9:7:-1].hex(), "idProduct": descriptors[11:9:-1].hex()}
        attributes = {
            "bConfigurationValue": "1",
            "busnum": str(bus),
            "devnum": str(number),
            "speed": str(speed.value),
            "version": f"{descriptors[3]:2x}.{descriptors[2]:02x}",
            "bcdDevice": descriptors[13:11:-1].hex(),
            "maxchild": "0",
            **identity,
            **texts,
        }
        node = f"/dev/bus/usb/{bus:03}/{number:03}"
        lines = [f"P: {devpath}", f"E: DEVNAME={node}", "E: SUBSYSTEM=usb", "E: DEVTYPE=usb_device", "E: DRIVER=usb"]
        lines += [
            f"E: BUSNUM={bus:03}",
            f"E: DEVNUM={number:03}",
            "E: MAJOR=189",
            f"E: MINOR={128 * (bus - 1) + number - 1}",
        ]
        lines += [f"E: PRODUCT={int(identity['idVendor'], 16):x}/{int(identity['idProduct'], 16):x}/0"]
        lines += [f"A: {name}={value}\\n" for name, value in attributes.items()]
        lines += [f"H: descriptors={descriptors.hex().upper()}"]
        error = ctypes.c_void_p()
        text = "\n".join(lines).encode() + b"\n"
        if not self._library.umockdev_testbed_add_from_string(self._handle, text, ctypes.byref(error)):
            raise RuntimeError(f"umockdev refused the device {devpath}")

    def close(self) -> None:
        """Remove the mocked files."""
        ctypes.CDLL("libgobject-2.0.so.0").g_object_unref(self._handle)
