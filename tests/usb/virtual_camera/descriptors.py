"""How an FT601 introduces itself: descriptors and the chip's configuration."""

import struct
from dataclasses import dataclass
from enum import Enum

SESSION_OUT, SESSION_IN, DATA_OUT, DATA_IN = 0x01, 0x81, 0x02, 0x82
_BULK, _INTERRUPT = 2, 3


class Speed(Enum):
    """The port's speed in Mbit/s, as sysfs writes it."""

    HIGH = 480
    SUPER = 5000


@dataclass(frozen=True)
class Identity:
    """What differs from one bridge to the next."""

    vendor: int = 0x0403
    product: int = 0x601F
    release: int = 0x0000
    manufacturer: str = "FTDI"
    name: str = "FTDI SuperSpeed-FIFO Bridge"
    serial: str = "000000000001"
    chip: tuple[int, int, int] = (0, 0, 2)
    """Codes of the bridge's clock, FIFO mode and channels: 100 MHz, 245 mode, one channel."""

    def device(self, speed: Speed) -> bytes:
        """The device descriptor, 18 bytes."""
        version, ep0 = (0x0300, 9) if speed is Speed.SUPER else (0x0210, 64)
        return struct.pack(
            "<BBHBBBBHHHBBBB", 18, 1, version, 0, 0, 0, ep0, self.vendor, self.product, self.release, 1, 2, 3, 1
        )

    def configuration(self, speed: Speed) -> bytes:
        """The configuration descriptor with both interfaces: the session, and the data."""
        interfaces = _interface(0, ((SESSION_OUT, _BULK), (SESSION_IN, _INTERRUPT)), speed)
        interfaces += _interface(1, ((DATA_OUT, _BULK), (DATA_IN, _BULK)), speed)
        return struct.pack("<BBHBBBBB", 9, 2, 9 + len(interfaces), 2, 1, 0, 0x80, 12) + interfaces

    def string(self, index: int) -> bytes | None:
        """A string descriptor, None if there is none of that index."""
        if index == 0:
            return struct.pack("<BBH", 4, 3, 0x0409)
        texts = {1: self.manufacturer, 2: self.name, 3: self.serial}
        if index not in texts:
            return None
        text = texts[index].encode("utf-16-le")
        return bytes((2 + len(text), 3)) + text

    def chip_configuration(self) -> bytes:
        """The 152 bytes of vendor request 0xCF, strings as in the descriptors."""
        strings = b"".join(self.string(index) or b"" for index in (1, 2, 3)).ljust(128, b"\0")
        power = struct.pack("<BBHBBBB", 9, 0xE0, 96, 0, *self.chip)
        return struct.pack("<HH", self.vendor, self.product) + strings + power + struct.pack("<HBBII", 0, 0, 0, 0, 0)


def _interface(number: int, endpoints: tuple[tuple[int, int], ...], speed: Speed) -> bytes:
    described = struct.pack("<BBBBBBBBB", 9, 4, number, 0, len(endpoints), 0xFF, 0xFF, 0xFF, 0)
    for address, kind in endpoints:
        packet = 64 if kind == _INTERRUPT else 1024 if speed is Speed.SUPER else 512
        described += struct.pack("<BBBBHB", 7, 5, address, kind, packet, 9 if kind == _INTERRUPT else 0)
        if speed is Speed.SUPER:
            burst = 0 if kind == _INTERRUPT else 15
            described += struct.pack("<BBBBH", 6, 48, burst, 0, packet if kind == _INTERRUPT else 0)
    return described
