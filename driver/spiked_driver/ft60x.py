"""What is said to FTDI's FT60x bridge: identity, endpoints, the request that asks for data, the chip's configuration.

The facts come from public drivers of the chip, not from its maker and not from tests on hardware; a correction belongs
here and nowhere else. No transfer is made here: bytes to send and bytes to understand.
"""

import struct
from dataclasses import dataclass
from enum import IntEnum

from spiked.errors import SourceError

VENDOR_ID = 0x0403
PRODUCTS = {0x601E: "FT600", 0x601F: "FT601"}
"""Product ids and the chips behind them; the SPS10-002 camera has an FT601."""

SESSION_INTERFACE, DATA_INTERFACE = 0, 1
SESSION_OUT = 0x01
"""Bulk endpoint that takes requests."""
NOTIFICATION_IN = 0x81
"""Interrupt endpoint; nothing that we know needs it."""
DATA_OUT = 0x02
"""Bulk endpoint that the camera's own software never writes to."""
DATA_IN = 0x82
"""Bulk endpoint of the camera's stream."""

REQUEST_TYPE, REQUEST_CONFIGURATION, REQUEST_VALUE, REQUEST_INDEX = 0xC0, 0xCF, 1, 0
"""The vendor request (device to host) that reads the chip's configuration, with its value and index."""
CONFIGURATION_BYTES = 152

_READ_REQUEST = struct.Struct("<IBBHIII")
READ_REQUEST_BYTES = _READ_REQUEST.size
_COMMAND_READ = 1
_CONFIGURATION = struct.Struct("<HH128sBBHBBBBHBBII")


def read_request(index: int, length: int) -> bytes:
    """The 20 bytes that, sent to SESSION_OUT, let up to `length` bytes come from DATA_IN; `index` counts requests.

    {u32 index, u8 pipe, u8 command 1 = read, u16 0, u32 length, u32 0, u32 0}, little endian.
    """
    return _READ_REQUEST.pack(index & 0xFFFFFFFF, DATA_IN, _COMMAND_READ, 0, length, 0, 0)


class FifoClock(IntEnum):
    """Clock of the bus between camera and chip; the value is the chip's code."""

    MHZ_100 = 0
    MHZ_66 = 1
    MHZ_50 = 2
    MHZ_40 = 3

    @property
    def mhz(self) -> int:
        """In megahertz."""
        return (100, 66, 50, 40)[self]


class FifoMode(IntEnum):
    """Protocol of the bus between camera and chip."""

    MODE_245 = 0
    MODE_600 = 1


@dataclass(frozen=True)
class ChipConfiguration:
    """What we use of the chip's stored configuration; None for a code that we do not know."""

    vendor_id: int
    product_id: int
    power_ma: int
    fifo_clock: FifoClock | None
    fifo_mode: FifoMode | None
    channels: int
    """The chip's code, not a number of channels: 2 is one channel, 4 one channel towards the host only."""

    @classmethod
    def parse(cls, data: bytes) -> "ChipConfiguration":
        """From the answer to REQUEST_CONFIGURATION. Raises SourceError if it has not the length it must have."""
        if len(data) != CONFIGURATION_BYTES:
            raise SourceError(
                f"the camera's USB bridge answered the request for its configuration with {len(data)} bytes, "
                f"not {CONFIGURATION_BYTES}: is it an FT600 or FT601?"
            )
        vendor, product, _, _, _, power, _, clock, mode, channels, _, _, _, _, _ = _CONFIGURATION.unpack(data)
        return cls(
            vendor,
            product,
            power,
            FifoClock(clock) if clock in list(FifoClock) else None,
            FifoMode(mode) if mode in list(FifoMode) else None,
            channels,
        )
