"""The camera as a USB device, whatever carries it: control requests, the FT60x session, the data endpoint."""

import struct
import time
from collections import deque
from dataclasses import dataclass
from enum import StrEnum

from .descriptors import DATA_IN, DATA_OUT, SESSION_IN, SESSION_OUT, Identity, Speed
from .faults import Fault, Kind
from .stream import Stream

_REQUEST = struct.Struct("<IBBHIII")
_ENDLESS = 1 << 62
_CONTROL = struct.Struct("<BBHHH")
_ABORT, _READ, _STREAM, _FLUSH = range(4)


class Bridge(StrEnum):
    """What makes the bridge send."""

    ALL = "all"
    REQUEST = "request"
    """Read requests only: stream mode is ignored."""
    STREAM = "stream"
    """Stream mode only: read requests are ignored."""
    SINGLE = "single"
    """One read request at a time: with a second one it sends nothing until it is aborted."""
    NOTHING = "nothing"


class Stalled(Exception):
    """The endpoint answers with STALL."""


@dataclass(frozen=True)
class Request:
    """A 20-byte read request, as the host wrote it on endpoint 0x01."""

    index: int
    length: int


class Camera:
    """An FT601 with a camera behind it. Data flow only as far as the host has asked for them on endpoint 0x01, or in
    stream mode."""

    def __init__(
        self,
        stream: Stream,
        identity: Identity | None = None,
        speed: Speed = Speed.SUPER,
        bridge: Bridge = Bridge.ALL,
    ) -> None:
        self.stream = stream
        self.bridge = bridge
        self.commands: list[int] = []
        """Session commands so far but for reads."""
        self._streams = False
        self._confused = False
        self.identity = identity or Identity()
        self.speed = speed
        self.halted = False
        self.requests: deque[Request] = deque(maxlen=64)
        """The last ones, for tests of the session."""
        self.bad_requests = 0
        self._asked: deque[int] = deque()
        self._room_since_s: float | None = None

    @property
    def credit(self) -> int:
        """Bytes that may be sent."""
        if self.bridge is Bridge.NOTHING or self._confused:
            return 0
        return _ENDLESS if self._streams else sum(self._asked)

    @property
    def descriptors(self) -> bytes:
        """The device descriptor and the configuration, as in sysfs."""
        return self.identity.device(self.speed) + self.identity.configuration(self.speed)

    def control(self, setup: bytes, data: bytes = b"") -> bytes:
        """Answer a control transfer; `setup` is its 8 bytes. Raises Stalled for what a bridge does not know."""
        kind, request, value, index, length = _CONTROL.unpack(setup)
        match kind, request:
            case 0x80, 6:
                answer = self._descriptor(value)
            case ((0x80 | 0x81 | 0x82), 0):
                answer = struct.pack("<H", int(self.halted and index == DATA_IN))
            case 0x80, 8:
                answer = b"\1"
            case 0x81, 10:
                answer = b"\0"
            case (0x00, 5) | (0x00, 9) | (0x01, 11) | (0x00, 0x30) | (0x00, 0x31) | (0x00, 3) | (0x00, 1):
                answer = b""
            case 0x02, 1:
                self.clear_halt(index)
                answer = b""
            case 0xC0, 0xCF:
                answer = self.identity.chip_configuration()
            case _:
                raise Stalled
        return answer[:length]

    def _descriptor(self, value: int) -> bytes:
        match value >> 8:
            case 1:
                return self.identity.device(self.speed)
            case 2:
                return self.identity.configuration(self.speed)
            case 3:
                text = self.identity.string(value & 0xFF)
                if text is not None:
                    return text
            case 15:  # SuperSpeed's own capabilities: U1/U2 latencies, nothing else
                capabilities = struct.pack("<BBBI", 7, 16, 2, 2) + struct.pack(
                    "<BBBBHBBH", 10, 16, 3, 0, 8, 3, 10, 2047
                )
                return struct.pack("<BBHB", 5, 15, 5 + len(capabilities), 2) + capabilities
        raise Stalled

    def write(self, endpoint: int, data: bytes) -> None:
        """A bulk OUT transfer: a session request, or data that no camera wants."""
        if endpoint == DATA_OUT:
            return
        if endpoint != SESSION_OUT or len(data) != _REQUEST.size:
            self.bad_requests += 1
            return
        index, pipe, command, zero, length, *rest = _REQUEST.unpack(data)
        wants_length = command in (_READ, _STREAM)
        if pipe != DATA_IN or command > _FLUSH or zero or any(rest) or bool(length) != wants_length:
            self.bad_requests += 1
            return
        if command == _READ:
            self.requests.append(Request(index, length))
            if self.bridge is not Bridge.STREAM and not self._streams:
                self._confused |= self.bridge is Bridge.SINGLE and bool(self._asked)
                self._asked.append(length)
            return
        self.commands.append(command)
        if command == _STREAM:
            self._streams = self.bridge in (Bridge.ALL, Bridge.STREAM)
        else:
            self._end_session()

    def _end_session(self) -> None:
        self._asked.clear()
        self._streams = self._confused = False

    def make_room(self, nbytes: int) -> None:
        """So much can be written at the host's end of the data endpoint now; tell of it whenever it changes."""
        if not nbytes or not self.credit or self.halted:
            self._room_since_s = None
        elif self._room_since_s is None:
            self._room_since_s = time.monotonic()

    def wait_s(self, endpoint: int, now_s: float, wanted_bytes: int) -> float | None:
        """How long until this IN endpoint has so many bytes; None: not before the host does something."""
        if endpoint == SESSION_IN:
            return None
        if self.halted:
            return 0.0
        return self.stream.wait_s(now_s, min(wanted_bytes, self.credit)) if self.credit else None

    def read(self, endpoint: int, limit: int) -> tuple[list[memoryview], Fault | None]:
        """Bytes for a transfer that has room for `limit` more, and what befalls it behind them."""
        if endpoint == SESSION_IN:
            return [], None
        if endpoint != DATA_IN:
            raise Stalled
        if self.halted:
            return [], Fault(0, Kind.STALL)
        now_s = time.monotonic()
        pieces, fault = self.stream.pull(min(limit, self.credit), now_s, self._room_since_s or now_s)
        self._use(sum(map(len, pieces)))
        if fault is not None:
            self.halted = self.halted or fault.kind is Kind.STALL
            if fault.kind in (Kind.CUT, Kind.BABBLE) and self._asked:
                self._asked.popleft()  # the request ends with its transfer
        return pieces, fault

    def _use(self, nbytes: int) -> None:
        if self._streams:
            return
        while nbytes and nbytes >= self._asked[0]:
            nbytes -= self._asked.popleft()
        if nbytes:
            self._asked[0] -= nbytes

    def clear_halt(self, endpoint: int) -> None:
        """The host clears a stall; what it asked for before is forgotten."""
        if endpoint == DATA_IN:
            self.reset()

    def reset(self) -> None:
        """The port is reset, or the device was unplugged: no session is left."""
        self.halted = False
        self._end_session()
