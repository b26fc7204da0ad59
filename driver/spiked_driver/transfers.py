"""Reads that stay queued at the camera: asynchronous libusb, or pyusb's synchronous reads where that cannot be.

The bytes lie where the kernel put them until `release`: framing reads them there and writes compact frames into the
ring, which is the one copy that this side of the kernel makes.
"""

import array
import ctypes
import errno
import mmap
import time
from collections import deque
from dataclasses import dataclass
from enum import StrEnum
from itertools import count
from typing import Protocol, TypeVar

import numpy as np
import usb.core
from numpy.typing import NDArray

from spiked_driver.ft60x import DATA_IN, READ_REQUEST_BYTES, SESSION_OUT, read_request
from spiked_driver.libusb import Callback, OutOfUsbMemoryError, Status, Transfer, UsbContext
from spiked_driver.usb_budget import MIN_TRANSFERS, TransferPlan


class Trouble(StrEnum):
    """What befell a read."""

    STALLED = "the endpoint stalled"
    BABBLE = "the camera sent more than it was asked for"
    FAILED = "a transfer failed"
    GONE = "the camera is gone"


_TROUBLES = {
    Status.ERROR: Trouble.FAILED,
    Status.STALL: Trouble.STALLED,
    Status.NO_DEVICE: Trouble.GONE,
    Status.OVERFLOW: Trouble.BABBLE,
}
"""The others, cancelled and timed out, are no trouble: what they brought are bytes like others."""
_BY_NUMBER = {errno.EPIPE: Trouble.STALLED, errno.EOVERFLOW: Trouble.BABBLE, errno.ENODEV: Trouble.GONE}
_SYNC_WAIT_MS = 100


@dataclass(frozen=True)
class Arrival:
    """The end of one read: bytes, trouble, or both, the bytes first."""

    data: NDArray[np.uint8]
    """uint8 [n], valid until `release`."""
    trouble: Trouble | None = None


class Reads(Protocol):
    """The camera's stream, read in transfers. Used by one thread."""

    @property
    def in_flight_bytes(self) -> int:
        """What the camera may send without our doing anything."""
        ...

    def ran_dry(self) -> int | None:
        """If the camera had nothing to write into at the last `release`: bytes that waited for `next`; else None."""
        ...

    def start(self) -> None:
        """Queue all reads. Raises usb.core.USBError, or OutOfUsbMemoryError where too few fit."""
        ...

    def next(self, timeout_s: float) -> Arrival | None:
        """What came next, in the camera's order; None after the timeout, or if nothing is queued."""
        ...

    def release(self) -> None:
        """The data of the last arrival is not needed any more; its buffer is queued again, unless reading stopped."""
        ...

    def stop(self, timeout_s: float) -> bool:
        """Cancel what is queued; false if that took too long. What had come before is still to be had by `next`."""
        ...

    def close(self) -> bool:
        """Let go of the transfers; false if some are still in flight, whose memory and device must then stay."""
        ...


class Buffers:
    """Memory for the transfers of a plan: made once, kept over unplugging, its pages present from the start."""

    def __init__(self, plan: TransferPlan) -> None:
        self.plan = plan
        flags = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | mmap.MAP_POPULATE
        memory = mmap.mmap(-1, plan.in_flight_bytes, flags=flags)
        self.rows = np.frombuffer(memory, np.uint8).reshape(plan.count, plan.transfer_bytes)
        """uint8 [count, transfer_bytes]."""


class _Read:
    """A buffer and its transfer."""

    def __init__(self, buffer: NDArray[np.uint8], transfer: Transfer) -> None:
        self.buffer = buffer
        self.transfer = transfer
        self.pending = False


class _Request:
    """A request's bytes and its transfer."""

    def __init__(self) -> None:
        self.bytes = ctypes.create_string_buffer(READ_REQUEST_BYTES)
        self.transfer: Transfer
        self.pending = False


_One = TypeVar("_One", _Read, _Request)

_abandoned: list[object] = []
"""Transfers that did not end: the kernel may still write into them, so nothing of theirs is ever freed."""


class AsynchronousReads:
    """As many reads in flight as the plan says, each asked for by a request of its own."""

    def __init__(self, context: UsbContext, buffers: Buffers) -> None:
        self._context = context
        self._buffers = buffers
        self._callback = Callback(self._ended)
        self._by_address: dict[int, _Read | _Request] = {}
        self._reads = [self._new_read(row) for row in buffers.rows]
        self._free_requests: list[_Request] = []
        self._requests = count()
        self._queue: deque[_Read] = deque()
        self._put_off: list[_Read] = []
        self._current: _Read | None = None
        self._in_flight = 0
        self._endings = 0
        self._dry: int | None = None
        self._running = False
        self._request_trouble: Trouble | None = None

    @property
    def in_flight_bytes(self) -> int:
        """See `Reads`."""
        return len(self._reads) * self._buffers.plan.transfer_bytes

    def ran_dry(self) -> int | None:
        """See `Reads`."""
        return self._dry

    def start(self) -> None:
        """See `Reads`; where the kernel takes at least a few transfers, those are what is used."""
        self._running = True
        self._request_trouble = None
        self._put_off.clear()
        for number, read in enumerate(self._reads):
            try:
                self._submit(read)
            except OutOfUsbMemoryError:
                if number < MIN_TRANSFERS:
                    raise
                for surplus in self._reads[number:]:
                    self._forget(surplus)
                del self._reads[number:]
                break

    def next(self, timeout_s: float) -> Arrival | None:
        """See `Reads`."""
        if not self._queue:
            return None
        self._wait(timeout_s)
        if self._queue[0].pending:
            trouble, self._request_trouble = self._request_trouble, None
            return Arrival(self._queue[0].buffer[:0], trouble) if trouble else None
        read = self._current = self._queue.popleft()
        status = Status(read.transfer.status)
        return Arrival(read.buffer[: read.transfer.actual_length], _TROUBLES.get(status))

    def release(self) -> None:
        """See `Reads`. Raises usb.core.USBError, or OutOfUsbMemoryError if nothing can be queued any more."""
        read, self._current = self._current, None
        self._dry = None
        if read is None or not self._running:
            return
        self._reap()
        if not self._in_flight:
            self._dry = sum(ended.transfer.actual_length for ended in self._queue)
        self._put_off.append(read)
        try:
            while self._put_off:
                self._submit(self._put_off[-1])
                self._put_off.pop()
        except OutOfUsbMemoryError:
            if not self._queue:
                raise

    def stop(self, timeout_s: float) -> bool:
        """See `Reads`."""
        self._running = False
        pending = [one for one in self._by_address.values() if one.pending]
        # Backwards, so that none is cancelled while a later one already takes its place at the camera.
        for one in reversed(pending):
            self._context.cancel(one.transfer)
        deadline = time.monotonic() + timeout_s
        while any(one.pending for one in pending):
            remaining_s = deadline - time.monotonic()
            if remaining_s <= 0:
                return False
            self._context.handle_events(remaining_s)
        return True

    def close(self) -> bool:
        """See `Reads`."""
        if any(one.pending for one in self._by_address.values()):
            _abandoned.append(self)
            return False
        for one in list(self._by_address.values()):
            self._forget(one)
        self._reads.clear()
        self._free_requests.clear()
        self._queue.clear()
        return True

    def _new_read(self, buffer: NDArray[np.uint8]) -> _Read:
        transfer = self._context.allocate(DATA_IN, buffer.ctypes.data, buffer.size, self._callback)
        return self._keep(_Read(buffer, transfer))

    def _new_request(self) -> _Request:
        request = _Request()
        request.transfer = self._context.allocate(
            SESSION_OUT, ctypes.addressof(request.bytes), READ_REQUEST_BYTES, self._callback
        )
        return self._keep(request)

    def _keep(self, one: _One) -> _One:
        self._by_address[ctypes.addressof(one.transfer)] = one
        return one

    def _forget(self, one: _Read | _Request) -> None:
        del self._by_address[ctypes.addressof(one.transfer)]
        self._context.free(one.transfer)

    def _submit(self, read: _Read) -> None:
        """Ask for the data first: the camera then has it when the read comes."""
        request = self._free_requests.pop() if self._free_requests else self._new_request()
        request.bytes.raw = read_request(next(self._requests), read.buffer.size)
        try:
            self._send(request)
        except BaseException:
            self._free_requests.append(request)
            raise
        self._send(read)
        self._queue.append(read)
        self._in_flight += 1

    def _send(self, one: _Read | _Request) -> None:
        one.pending = True
        try:
            self._context.submit(one.transfer)
        except BaseException:
            one.pending = False
            raise

    def _wait(self, timeout_s: float) -> None:
        """Until the oldest read has ended."""
        deadline = time.monotonic() + timeout_s
        while self._queue[0].pending and self._request_trouble is None:
            remaining_s = deadline - time.monotonic()
            if remaining_s <= 0:
                return
            self._context.handle_events(remaining_s)

    def _reap(self) -> None:
        """Hear of all that has ended; libusb looks at no more than a few at a time."""
        seen = -1
        while seen != self._endings:
            seen = self._endings
            self._context.handle_events(0)

    def _ended(self, address: int) -> None:
        """Called by libusb: nothing here may raise, or take long."""
        one = self._by_address[address]
        one.pending = False
        self._endings += 1
        if isinstance(one, _Request):
            self._free_requests.append(one)
            if one.transfer.status != Status.COMPLETED and self._running:
                self._request_trouble = _TROUBLES.get(Status(one.transfer.status), Trouble.FAILED)
        else:
            self._in_flight -= 1


class SynchronousReads:
    """One read at a time by pyusb alone: what the host hides is next to nothing, since nothing is queued in between."""

    def __init__(self, device: usb.core.Device, plan: TransferPlan) -> None:
        self._device = device
        self._buffer = array.array("B", bytes(plan.transfer_bytes))
        self._view = np.frombuffer(self._buffer, np.uint8)
        self._requests = count()
        self._asked = 0
        self._running = False

    @property
    def in_flight_bytes(self) -> int:
        """See `Reads`."""
        return len(self._buffer)

    def ran_dry(self) -> int | None:
        """See `Reads`; always, between two reads."""
        return 0

    def start(self) -> None:
        """See `Reads`."""
        self._asked = 0
        self._running = True

    def next(self, timeout_s: float) -> Arrival | None:
        """See `Reads`."""
        if not self._running:
            return None
        try:
            if not self._asked:
                request = read_request(next(self._requests), self._view.size)
                self._device.write(SESSION_OUT, request, _SYNC_WAIT_MS)
                self._asked = self._view.size
            timeout_ms = max(1, round(1e3 * timeout_s))
            size = self._device.read(DATA_IN, self._buffer, timeout_ms)
        except usb.core.USBTimeoutError:
            return None  # without a byte: the request stays open
        except usb.core.USBError as error:
            self._asked = 0
            return Arrival(self._view[:0], trouble_of(error))
        self._asked = 0
        return Arrival(self._view[:size])

    def release(self) -> None:
        """See `Reads`."""

    def stop(self, timeout_s: float) -> bool:
        """See `Reads`."""
        self._running = False
        return True

    def close(self) -> bool:
        """See `Reads`."""
        return True


def trouble_of(error: usb.core.USBError) -> Trouble:
    """What a failed call of pyusb means. Unplugging has many error numbers; whether it is that, the bus must tell."""
    return _BY_NUMBER.get(error.errno or 0, Trouble.FAILED)
