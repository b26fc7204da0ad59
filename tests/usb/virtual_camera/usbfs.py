"""A camera behind a device node: answers the ioctls of usbfs for a libusb that runs under umockdev.

umockdev's preloaded library sends each ioctl of a mocked node to a Unix socket and does what is answered: lets its
caller's memory be read and written, and returns. libumockdev has a server for it, which copies every buffer both ways;
at 260 MB/s that is the bottleneck, so this is a server of our own for the same socket, which writes what the camera
sends into the caller's memory as a host controller would (where the system permits it, else over the socket). The node
itself is a FIFO: a full one cannot be written, so that poll says what it says of usbfs: there is something to reap.
"""

import ctypes
import errno
import fcntl
import os
import socket
import struct
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import numpy as np

from .core import Camera, Stalled
from .descriptors import DATA_IN
from .faults import Fault, Kind

_MESSAGE = struct.Struct("@LLL")
_IOCTL, _DONE, _READ_MEMORY, _WRITE_MEMORY, _READ, _WRITE = 1, 3, 5, 6, 7, 8
_NOT_HANDLED = -100

_URB = struct.Struct("@BBxxiIxxxxQiiiiiIQ")
_STATUS, _ACTUAL_LENGTH = 4, 28
_URB_CONTROL, _URB_BULK, _URB_INTERRUPT = 2, 3, 1
_SHORT_NOT_OK = 1
_URB_OVERHEAD = 320
"""Bytes of the kernel's memory that usbfs counts for a transfer besides its buffer."""
_CAPABILITIES = 0x01 | 0x02 | 0x04 | 0x08 | 0x10  # zero packet, continuation, no size limit, scatter-gather, late reap
_F_SETPIPE_SZ = 1031
_LOOK_AGAIN_S = 0.01


def _io(number: int, size: int = 0, direction: int = 0) -> int:
    return direction << 30 | size << 16 | ord("U") << 8 | number


SUBMITURB, DISCARDURB, REAPURB, REAPURBNDELAY = _io(10, 56, 2), _io(11), _io(12, 8, 1), _io(13, 8, 1)
CLAIM, RELEASE, DISCONNECT_CLAIM = _io(15, 4, 2), _io(16, 4, 2), _io(27, 264, 2)
SET_CONFIGURATION, SET_INTERFACE, RESET_ENDPOINT, CLEAR_HALT = _io(5, 4, 2), _io(4, 8, 2), _io(3, 4, 2), _io(21, 4, 2)
RESET, GET_CAPABILITIES, GET_DRIVER, DRIVER_IOCTL = _io(20), _io(26, 4, 2), _io(8, 260, 1), _io(18, 16, 3)
GET_SPEED = _io(31)


class Memory:
    """Another process's memory: directly where permitted, else by asking it over the socket while it waits there."""

    def __init__(self, connection: socket.socket, direct: bool = True) -> None:
        self._connection = connection
        self._pid = struct.unpack("3i", connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))[0]
        self.direct = direct

    def read(self, address: int, count: int) -> bytes:
        """So many bytes from there. The process must be waiting in an ioctl."""
        if self.direct:
            buffer = ctypes.create_string_buffer(count)
            if self._move(_libc.process_vm_readv, ((ctypes.addressof(buffer), count),), address, count):
                return buffer.raw
        self._connection.sendall(_MESSAGE.pack(_READ_MEMORY, address, count))
        return receive(self._connection, count)

    def write(self, address: int, data: bytes) -> None:
        """Put the bytes there. The process must be waiting in an ioctl."""
        if not (self.direct and self.write_now(address, [memoryview(data)])):
            self._connection.sendall(_MESSAGE.pack(_WRITE_MEMORY, address, len(data)) + data)

    def write_now(self, address: int, pieces: list[memoryview]) -> bool:
        """Put the bytes there whatever the process does; false if the system does not permit it."""
        local = [(_address(piece), len(piece)) for piece in pieces]
        return self._move(_libc.process_vm_writev, tuple(local), address, sum(length for _, length in local))

    def _move(self, call: Callable[..., int], local: tuple[tuple[int, int], ...], address: int, count: int) -> bool:
        here = (_Piece * len(local))(*local)
        there = (_Piece * 1)((address, count))
        moved = call(self._pid, here, len(local), there, 1, 0)
        if moved == count:
            return True
        if ctypes.get_errno() in (errno.EPERM, errno.ENOSYS):
            self.direct = False
        return False


class _Piece(ctypes.Structure):
    _fields_ = (("base", ctypes.c_void_p), ("length", ctypes.c_size_t))


_libc = ctypes.CDLL(None, use_errno=True)
for _call in (_libc.process_vm_readv, _libc.process_vm_writev):
    _call.restype = ctypes.c_ssize_t
    _call.argtypes = (
        ctypes.c_int,
        ctypes.POINTER(_Piece),
        ctypes.c_ulong,
        ctypes.POINTER(_Piece),
        ctypes.c_ulong,
        ctypes.c_ulong,
    )


def _address(piece: memoryview) -> int:
    return int(np.frombuffer(piece, np.uint8).ctypes.data)


def receive(connection: socket.socket, count: int) -> bytes:
    """Exactly so many bytes. Raises ConnectionError at the end of the stream."""
    data = bytearray()
    while len(data) < count:
        piece = connection.recv(count - len(data))
        if not piece:
            raise ConnectionError("the other side closed the connection")
        data += piece
    return bytes(data)


@dataclass(eq=False)
class Urb:
    """A transfer in flight."""

    address: int
    kind: int
    endpoint: int
    buffer: int
    length: int
    actual: int = 0
    status: int = 0
    last_frame: int | None = None
    """Of a full bulk transfer: the frame in which it ends."""
    kept: bytearray = field(default_factory=bytearray)
    """What could not be written into the process's memory at once."""


@dataclass
class Limits:
    """What the kernel allows."""

    usbfs_memory_bytes: int | None = 16 << 20
    direct_memory: bool = True


class Client:
    """One open file of the device node."""

    def __init__(self, connection: socket.socket, node: "Node") -> None:
        self.connection = connection
        self.node = node
        self.memory = Memory(connection, node.limits.direct_memory)
        self.pending: deque[Urb] = deque()
        self.completed: deque[Urb] = deque()
        self.claimed: set[int] = set()
        self._waits: int | None = None  # where a blocking reap puts its answer

    def serve(self) -> None:
        """Answer one ioctl. Raises ConnectionError when the file was closed."""
        command, request, argument = _MESSAGE.unpack(receive(self.connection, _MESSAGE.size))
        if command == _IOCTL:
            try:
                result = self._ioctl(request & 0xFFFFFFFF, argument)
            except OSError as error:
                if isinstance(error, ConnectionError):
                    raise
                self._done(-1, error.errno or errno.EIO)
            else:
                if result is not None:
                    self._done(result)
        elif command in (_READ, _WRITE):
            self._done(_NOT_HANDLED)
        else:
            raise ConnectionError(f"umockdev sent command {command}, which this server does not know")

    def _done(self, result: int, error: int = 0) -> None:
        self.node.show()  # first: the process may poll as soon as it has its answer
        self.connection.sendall(_MESSAGE.pack(_DONE, result & (1 << 64) - 1, error))

    def _ioctl(self, request: int, argument: int) -> int | None:
        camera, gone = self.node.camera, self.node.gone
        if request in (REAPURB, REAPURBNDELAY):
            return self._reap(argument, wait=request == REAPURB)
        if request == DISCARDURB:
            return self._discard(argument)
        if gone:
            raise OSError(errno.ENODEV, "unplugged")
        match request:
            case _ if request == SUBMITURB:
                self._submit(argument)
            case _ if request == GET_CAPABILITIES:
                self.memory.write(argument, struct.pack("<I", _CAPABILITIES))
            case _ if request in (CLAIM, DISCONNECT_CLAIM):
                self._claim(struct.unpack("<I", self.memory.read(argument, 4))[0])
            case _ if request == RELEASE:
                self.claimed.discard(struct.unpack("<I", self.memory.read(argument, 4))[0])
            case _ if request == CLEAR_HALT:
                camera.clear_halt(struct.unpack("<I", self.memory.read(argument, 4))[0])
            case _ if request in (SET_CONFIGURATION, SET_INTERFACE, RESET_ENDPOINT):
                pass
            case _ if request == RESET:
                self.node.reset()
            case _ if request == GET_SPEED:
                return 5 if camera.speed.value == 5000 else 3
            case _ if request in (GET_DRIVER, DRIVER_IOCTL):
                raise OSError(errno.ENODATA, "no kernel driver")
            case _:
                raise OSError(errno.ENOTTY, "not emulated")
        return 0

    def _claim(self, interface: int) -> None:
        if interface not in (0, 1):
            raise OSError(errno.ENOENT, "no such interface")
        if any(interface in other.claimed for other in self.node.clients if other is not self):
            raise OSError(errno.EBUSY, "claimed by another")
        self.claimed.add(interface)

    def _submit(self, address: int) -> None:
        kind, endpoint, _, _, buffer, length, *_ = _URB.unpack(self.memory.read(address, _URB.size))
        urb = Urb(address, kind, endpoint, buffer, length)
        limit = self.node.limits.usbfs_memory_bytes
        if limit is not None and self.node.in_flight_bytes() + length + _URB_OVERHEAD > limit:
            raise OSError(errno.ENOMEM, "over usbfs_memory_mb")
        if kind == _URB_CONTROL:
            self._control(urb)
        elif kind not in (_URB_BULK, _URB_INTERRUPT):
            raise OSError(errno.EINVAL, "not a transfer of this device")
        elif endpoint & 0x80:
            self.pending.append(urb)
        else:
            self.node.camera.write(endpoint, self.memory.read(buffer, length))
            urb.actual = length
            self.completed.append(urb)

    def _control(self, urb: Urb) -> None:
        data = self.memory.read(urb.buffer, urb.length)
        try:
            answer = self.node.camera.control(data[:8], data[8:])
        except Stalled:
            urb.status = -errno.EPIPE
        else:
            if data[0] & 0x80:
                urb.actual = len(answer)
                if answer:
                    self.memory.write(urb.buffer + 8, answer)
            else:
                urb.actual = urb.length - 8
        self.completed.append(urb)

    def _discard(self, address: int) -> int:
        self.node.pump()  # what has come by now stays
        for urb in self.completed:
            if urb.address == address:
                raise OSError(errno.EINVAL, "over by now")
        for urb in self.pending:
            if urb.address == address:
                self.pending.remove(urb)
                urb.status = -errno.ENOENT
                self.completed.append(urb)
                return 0
        raise OSError(errno.EINVAL, "not in flight")

    def _reap(self, argument: int, *, wait: bool) -> int | None:
        if self.completed:
            self._hand_over(argument)
            return 0
        if self.node.gone:
            raise OSError(errno.ENODEV, "unplugged")
        if wait and self.pending:
            self._waits = argument
            return None
        raise OSError(errno.EAGAIN, "nothing to reap")

    def _hand_over(self, argument: int) -> None:
        urb = self.completed.popleft()
        if urb.kept:
            self.memory.write(urb.buffer, bytes(urb.kept))
        self.memory.write(urb.address + _STATUS, struct.pack("<i", urb.status))
        self.memory.write(urb.address + _ACTUAL_LENGTH, struct.pack("<i", urb.actual))
        self.memory.write(argument, struct.pack("<Q", urb.address))
        if urb.last_frame is not None:
            self.node.camera.stream.handed_over.append((urb.last_frame, time.monotonic()))

    def answer_waiting(self) -> None:
        """Let a blocking reap return, if there is one and something to return."""
        if self._waits is not None and (self.completed or self.node.gone):
            argument, self._waits = self._waits, None
            if self.completed:
                self._hand_over(argument)
                self._done(0)
            else:
                self._done(-1, errno.ENODEV)

    def fill(self, urb: Urb, pieces: list[memoryview]) -> None:
        """Put bytes behind those that the transfer has."""
        count = sum(map(len, pieces))
        if not count:
            return
        direct = self.memory.direct and not urb.kept
        if not (direct and self.memory.write_now(urb.buffer + urb.actual, pieces)):
            for piece in pieces:
                urb.kept += piece
        urb.actual += count


class Node:
    """A device node: its camera, and who has it open."""

    def __init__(self, camera: Camera, fifo: str, limits: Limits, on_fault: Callable[[Fault], None]) -> None:
        self.camera = camera
        self.limits = limits
        self.clients: list[Client] = []
        self.gone = False
        self._on_fault = on_fault
        self._fifo = os.open(fifo, os.O_RDWR | os.O_NONBLOCK)
        fcntl.fcntl(self._fifo, _F_SETPIPE_SZ, 4096)
        self._readable = True
        self.show()

    def in_flight_bytes(self) -> int:
        """What usbfs counts against its limit."""
        urbs = [urb for client in self.clients for urb in (*client.pending, *client.completed)]
        return sum(urb.length + _URB_OVERHEAD for urb in urbs)

    def wait_s(self, now_s: float) -> float | None:
        """How long until a transfer in flight can go on; None: not by itself."""
        waits = []
        for client in self.clients:
            urb = _first_bulk(client.pending)
            if urb is not None:
                waits.append(self.camera.wait_s(urb.endpoint, now_s, urb.length - urb.actual))
        soonest = min((wait for wait in waits if wait is not None), default=None)
        return None if soonest is None else min(soonest, _LOOK_AGAIN_S)

    def pump(self) -> None:
        """Let the camera send into the transfers in flight, in their order, and say what is to be reaped."""
        self.camera.make_room(self.room_bytes())
        for client in self.clients:
            while client.pending and not self.gone and self._send(client):
                pass
            client.answer_waiting()
        self.camera.make_room(self.room_bytes())
        self.show()

    def room_bytes(self) -> int:
        """What the camera can send into the bulk transfers in flight."""
        return sum(
            urb.length - urb.actual for client in self.clients for urb in client.pending if urb.kind == _URB_BULK
        )

    def _send(self, client: Client) -> bool:
        urb = _first_bulk(client.pending)
        if urb is None:
            return False
        try:
            pieces, fault = self.camera.read(urb.endpoint, urb.length - urb.actual)
        except Stalled:
            pieces, fault = [], Fault(0, Kind.STALL)
        client.fill(urb, pieces)
        if fault is None:
            if urb.actual < urb.length:
                return bool(pieces)
            if urb.endpoint == DATA_IN:
                urb.last_frame = self.camera.stream.next_frame - 1
        elif fault.kind is Kind.STALL:
            urb.status = -errno.EPIPE
        elif fault.kind is Kind.BABBLE:
            urb.status = -errno.EOVERFLOW
        elif fault.kind is Kind.UNPLUG:
            self._on_fault(fault)
            return False
        client.pending.remove(urb)
        client.completed.append(urb)
        return True

    def reset(self) -> None:
        """The port is reset: whatever is in flight ends."""
        self.camera.reset()
        for client in self.clients:
            self._fail(client, -errno.ENOENT, -errno.ENOENT)

    def unplug(self) -> None:
        """The device is gone: transfers fail, and so does everything else. Close when its clients have closed."""
        self.gone = True
        self.camera.reset()
        for client in self.clients:
            self._fail(client, -errno.EPROTO, -errno.ESHUTDOWN)
        self.pump()

    @staticmethod
    def _fail(client: Client, first: int, others: int) -> None:
        for urb in client.pending:
            urb.status, first = first, others
            client.completed.append(urb)
        client.pending.clear()

    def show(self) -> None:
        """Make the node writable when there is something to reap, or the device is gone."""
        ready = self.gone or any(client.completed for client in self.clients)
        if ready and not self._readable:
            os.read(self._fifo, 1)
        elif not ready and self._readable:
            os.write(self._fifo, b"\0")
        self._readable = ready

    def close(self) -> None:
        """Let go of the node."""
        for client in self.clients:
            client.connection.close()
        self.clients.clear()
        os.close(self._fifo)


def _first_bulk(urbs: Iterable[Urb]) -> Urb | None:
    return next((urb for urb in urbs if urb.kind == _URB_BULK), None)
