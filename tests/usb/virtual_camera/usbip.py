"""A camera at the other end of a USB/IP connection: what the kernel's vhci-hcd asks, answered.

Messages are big-endian, 48 bytes of header and then the data, if any (linux/Documentation/usb/usbip_protocol.rst).
"""

import errno
import selectors
import socket
import struct
import threading
import time
from collections import deque
from dataclasses import dataclass

from .core import Camera, Stalled
from .descriptors import DATA_IN, SESSION_IN
from .faults import Fault, Kind
from .usbfs import receive

_SUBMIT, _UNLINK, _RET_SUBMIT, _RET_UNLINK = 1, 2, 3, 4
_HEADER = struct.Struct(">IIIII")
_COMMAND = struct.Struct(">Iiiii8s")
_ANSWER = struct.Struct(">IIIIIiiiii8x")
_IN = 1


@dataclass
class _Transfer:
    """A transfer that the kernel waits for."""

    number: int
    endpoint: int
    length: int
    data: bytearray


class UsbIpCamera:
    """Serves a camera over a connected stream socket in a thread, until it is unplugged.

    The socket is the one that vhci-hcd was given the other end of; the exchange in which a USB/IP host exports a device
    is over by then, or left out.
    """

    def __init__(self, connection: socket.socket, camera: Camera) -> None:
        self.camera = camera
        self.unplugged = threading.Event()
        """The camera has left, of itself or because it was told to."""
        self.left: Fault | None = None
        """The fault by which it left of itself."""
        self._connection = connection
        self._waiting: deque[_Transfer] = deque()
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._serve, name="usbip", daemon=True)
        self._thread.start()

    def unplug(self) -> None:
        """Pull the camera out: the connection ends, and the kernel sees the device vanish."""
        self._connection.shutdown(socket.SHUT_RDWR)
        self._thread.join(10)

    def add(self, fault: Fault) -> None:
        """One more fault."""
        with self._lock:
            self.camera.stream.add(fault)

    def _serve(self) -> None:
        try:
            with selectors.DefaultSelector() as selector:
                selector.register(self._connection, selectors.EVENT_READ)
                while not self.unplugged.is_set():
                    if selector.select(self._timeout_s()):
                        self._obey()
                    with self._lock:
                        self._pump()
        except (ConnectionError, OSError):
            pass  # the kernel, or unplug, has closed the connection
        finally:
            self.unplugged.set()
            self.camera.reset()
            self._connection.close()

    def _timeout_s(self) -> float | None:
        now_s = time.monotonic()
        waits = [
            self.camera.wait_s(0x80 | transfer.endpoint, now_s, transfer.length - len(transfer.data))
            for transfer in self._waiting
        ]
        soonest = min((wait for wait in waits if wait is not None), default=None)
        return None if soonest is None else min(max(0.001, soonest), 0.01)

    def _obey(self) -> None:
        command, number, _, direction, endpoint = _HEADER.unpack(receive(self._connection, _HEADER.size))
        rest = receive(self._connection, _COMMAND.size)
        _, length, _, _, _, setup = _COMMAND.unpack(rest)
        if command == _UNLINK:
            self._unlink(number, struct.unpack_from(">I", rest)[0])
        elif command != _SUBMIT:
            raise ConnectionError(f"the kernel sent command {command}")
        elif endpoint == 0:
            data = receive(self._connection, length) if direction != _IN else b""
            self._control(number, direction, setup, data)
        elif direction == _IN:
            self._waiting.append(_Transfer(number, endpoint, length, bytearray()))
        else:
            self.camera.write(endpoint, receive(self._connection, length))
            self._answer(number, 0, actual=length)

    def _control(self, number: int, direction: int, setup: bytes, data: bytes) -> None:
        try:
            answer = self.camera.control(setup, data)
        except Stalled:
            self._answer(number, -errno.EPIPE)
        else:
            self._answer(number, 0, answer if direction == _IN else b"", None if direction == _IN else len(data))

    def _unlink(self, number: int, which: int) -> None:
        found = next((transfer for transfer in self._waiting if transfer.number == which), None)
        status = 0
        if found is not None:
            self._waiting.remove(found)
            if found.data:  # over, though not full: what was sent is not to be lost
                self._answer(found.number, 0, bytes(found.data))
            else:
                status = -errno.ECONNRESET
        self._connection.sendall(_ANSWER.pack(_RET_UNLINK, number, 0, 0, 0, status, 0, 0, 0, 0))

    def _pump(self) -> None:
        self.camera.make_room(self._room())
        for transfer in list(self._waiting):
            if self._send(transfer):
                self._waiting.remove(transfer)
            elif 0x80 | transfer.endpoint != SESSION_IN:
                break  # in their order
        self.camera.make_room(self._room())

    def _room(self) -> int:
        data = [transfer for transfer in self._waiting if 0x80 | transfer.endpoint == DATA_IN]
        return sum(transfer.length - len(transfer.data) for transfer in data)

    def _send(self, transfer: _Transfer) -> bool:
        """Let the camera send into the transfer; whether it is over."""
        while len(transfer.data) < transfer.length:
            try:
                pieces, fault = self.camera.read(0x80 | transfer.endpoint, transfer.length - len(transfer.data))
            except Stalled:
                pieces, fault = [], Fault(0, Kind.STALL)
            for piece in pieces:
                transfer.data += piece
            if fault is None:
                if not pieces:
                    return False
                continue
            if fault.kind is Kind.UNPLUG:
                self.left = fault
                raise ConnectionAbortedError("unplugged")
            status = {Kind.STALL: -errno.EPIPE, Kind.BABBLE: -errno.EOVERFLOW}.get(fault.kind, 0)
            self._answer(transfer.number, status, bytes(transfer.data))
            return True
        self._answer(transfer.number, 0, bytes(transfer.data))
        return True

    def _answer(self, number: int, status: int, data: bytes = b"", actual: int | None = None) -> None:
        length = len(data) if actual is None else actual
        self._connection.sendall(_ANSWER.pack(_RET_SUBMIT, number, 0, 0, 0, status, length, 0, 0, 0) + data)
