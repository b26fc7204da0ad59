"""Protocol of FTDI's FT60x bridge: identity, endpoints, session requests, the chip's configuration.

The facts come from public drivers of the chip, not from its maker, and were not tested on hardware: docs/usb.md has the
table with the source of each. Corrections belong here. This module encodes and decodes bytes; it makes no transfer.
"""

import struct
from dataclasses import dataclass
from enum import IntEnum, StrEnum
from itertools import count

from spiked.errors import SourceError

VENDOR_ID = 0x0403
"""USB vendor id of FTDI."""
PRODUCTS = {0x601E: "FT600", 0x601F: "FT601"}
"""Chip by USB product id; the SPS10-002 camera has an FT601."""

SESSION_INTERFACE, DATA_INTERFACE = 0, 1
"""Numbers of the chip's USB interfaces."""
SESSION_OUT = 0x01
"""Bulk endpoint for requests."""
NOTIFICATION_IN = 0x81
"""Interrupt endpoint; not used."""
DATA_OUT = 0x02
"""Bulk endpoint; the vendor's software never writes to it."""
DATA_IN = 0x82
"""Bulk endpoint of the camera's stream."""

REQUEST_TYPE, REQUEST_CONFIGURATION, REQUEST_VALUE, REQUEST_INDEX = 0xC0, 0xCF, 1, 0
"""Vendor request (device to host) that reads the chip's configuration."""
CONFIGURATION_BYTES = 152
"""Length of the configuration."""

_SESSION_REQUEST = struct.Struct("<IBBHIII")
SESSION_REQUEST_BYTES = _SESSION_REQUEST.size
_CONFIGURATION = struct.Struct("<HH128sBBHBBBBHBBII")


class SessionMode(StrEnum):
    """How the bridge is made to send."""

    REQUEST = "request"
    """Each read is asked for with its length."""
    STREAM = "stream"
    """The bridge is put into stream mode once; reads are not asked for."""

    def __str__(self) -> str:
        """As shown to users."""
        return "read requests" if self is SessionMode.REQUEST else "stream mode"


class SessionCommand(IntEnum):
    """Command byte of a session request."""

    ABORT = 0
    READ = 1
    STREAM = 2
    FLUSH = 3


class SessionRequests:
    """Requests for SESSION_OUT, numbered from `first` on."""

    def __init__(self, first: int = 0) -> None:
        self._numbers = count(first)

    def encode(self, command: SessionCommand, length: int = 0) -> bytes:
        """The next request, 20 bytes, little endian; `length` is that of a read, or of all reads in stream mode.

        {u32 number, u8 pipe, u8 command, u16 0, u32 length, u32 0, u32 0}.
        """
        number = next(self._numbers) & 0xFFFFFFFF
        return _SESSION_REQUEST.pack(number, DATA_IN, command, 0, length, 0, 0)


class FifoClock(IntEnum):
    """Clock of the bus between camera and chip, by the chip's code."""

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


class Channels(IntEnum):
    """Channels between camera and host, by the chip's code."""

    FOUR = 0
    TWO = 1
    ONE = 2
    ONE_TO_CAMERA = 3
    ONE_TO_HOST = 4

    def __str__(self) -> str:
        """As shown to users."""
        return self.name.lower().replace("_", " ") + (" channel" if self >= Channels.ONE else " channels")


_BUS_BYTES = {0x601E: 2, 0x601F: 4}
"""Bytes per clock of the bus between camera and chip, by product id."""
_REMEDY = "set it with FTDI's FT60X configuration programmer to one channel, FIFO mode 245, 100 MHz"


@dataclass(frozen=True)
class ChipConfiguration:
    """Fields of the chip's stored configuration; None for an unknown code."""

    vendor_id: int
    product_id: int
    power_ma: int
    fifo_clock: FifoClock | None
    fifo_mode: FifoMode | None
    channels: Channels | None

    @classmethod
    def parse(cls, data: bytes) -> "ChipConfiguration":
        """From the answer to REQUEST_CONFIGURATION. Raises SourceError for an answer of another length."""
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
            Channels(channels) if channels in list(Channels) else None,
        )

    def __str__(self) -> str:
        """As shown to users."""
        mode = "unknown FIFO mode" if self.fifo_mode is None else f"FIFO mode {self.fifo_mode.name[5:]}"
        clock = "unknown clock" if self.fifo_clock is None else f"{self.fifo_clock.mhz} MHz"
        return f"{mode}, {clock}, {'unknown channels' if self.channels is None else self.channels}"

    def impossible(self, wire_bytes_s: float) -> str | None:
        """Why the chip cannot carry that many bytes a second, and what to do; None if it can."""
        if self.channels is Channels.ONE_TO_CAMERA:
            return f"its bridge has no channel to the host: {_REMEDY}"
        if self.fifo_clock is None:
            return None
        carries = 1e6 * self.fifo_clock.mhz * _BUS_BYTES.get(self.product_id, 4)
        if carries >= wire_bytes_s:
            return None
        what = f"its bridge's bus carries {carries / 1e6:.0f} MB/s at {self.fifo_clock.mhz} MHz"
        return f"{what}, and the camera sends {wire_bytes_s / 1e6:.0f}: {_REMEDY}"

    def unusual(self) -> str | None:
        """Settings that differ from an SPS10's and may still work, and what to do; None if there are none."""
        odd = []
        if self.fifo_mode is not FifoMode.MODE_245:
            odd.append("unknown FIFO mode" if self.fifo_mode is None else f"FIFO mode {self.fifo_mode.name[5:]}")
        if self.channels not in (Channels.ONE, Channels.ONE_TO_HOST):
            odd.append("unknown channels" if self.channels is None else f"{self.channels}")
        if self.fifo_clock is None:
            odd.append("unknown clock")
        if not odd:
            return None
        return f"its bridge has {' and '.join(odd)}, and only the first channel is read: if no frames come, {_REMEDY}"
