"""Bulk reads of the camera's stream: queued by asynchronous libusb, or one at a time by pyusb as a fallback.

The bytes stay in the transfer's buffer until `release`. Framing reads them there and writes compact frames into the
ring: one copy in user space.
"""

import array
import ctypes
import errno
import mmap
import time
from collections import deque
from dataclasses import dataclass, field
from enum import StrEnum
from itertools import islice
from typing import Protocol, TypeVar

import numpy as np
import usb.core
from numpy.typing import NDArray

from spiked_driver.ft60x import (
    DATA_IN,
    SESSION_OUT,
    SESSION_REQUEST_BYTES,
    SessionCommand,
    SessionRequests,
)
from spiked_driver.libusb import Callback, OutOfUsbMemoryError, Transfer, TransferStatus, UsbContext
from spiked_driver.usb_budget import MIN_TRANSFERS, TransferPlan


class TransferError(StrEnum):
    """How a transfer failed."""

    STALLED = "the endpoint stalled"
    BABBLE = "the camera sent more than was requested"
    FAILED = "a transfer failed"
    GONE = "the camera is gone"


_ERRORS = {
    TransferStatus.ERROR: TransferError.FAILED,
    TransferStatus.STALL: TransferError.STALLED,
    TransferStatus.NO_DEVICE: TransferError.GONE,
    TransferStatus.OVERFLOW: TransferError.BABBLE,
}
"""Cancelled and timed-out transfers are no errors: their bytes are used like all others."""
_BY_NUMBER = {
    errno.EPIPE: TransferError.STALLED,
    errno.EOVERFLOW: TransferError.BABBLE,
    errno.ENODEV: TransferError.GONE,
}
MOST_REQUESTS = 64
"""Requests that the bridge holds at a time, at most; how many it can hold is not public."""
_REQUEST_TIMEOUT_MS = 100
"""Time for a request of 20 bytes to be sent, ms."""


@dataclass(frozen=True)
class CompletedTransfer:
    """A completed read: bytes, an error, or both, the bytes first."""

    data: NDArray[np.uint8]
    """uint8 [n], valid until `release`."""
    error: TransferError | None = None
    seen_ns: int = field(default_factory=time.monotonic_ns)
    """Monotonic time, ns, at which it was seen to be complete; others may have been dealt with since."""


class BulkReader(Protocol):
    """Reads the camera's stream in transfers. Used by one thread."""

    @property
    def in_flight_bytes(self) -> int:
        """Bytes of all reads: what the camera can send while the host is busy."""
        ...

    def underrun_bytes(self) -> int | None:
        """If no read was queued at the last `release`: bytes that were complete and not taken then. Else None."""
        ...

    def start(self) -> None:
        """Queue all reads. Raises usb.core.USBError, or OutOfUsbMemoryError where too few fit."""
        ...

    def next(self, timeout_s: float) -> CompletedTransfer | None:
        """The next completed transfer, in the camera's order; None after the timeout, or if no read is queued."""
        ...

    def release(self) -> None:
        """Queue the buffer of the last transfer again, unless reading has stopped. Its data is invalid from now on."""
        ...

    def stop(self, timeout_s: float) -> bool:
        """Cancel all queued reads; false if some do not end in time. `next` still returns those that have completed."""
        ...

    def close(self) -> bool:
        """Free the transfers; false if some are still in flight: their memory and the open device must then stay."""
        ...


class Buffers:
    """Memory for the transfers of a plan. Allocated once, kept over unplugging, all pages present from the start."""

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
        self.seen_ns = 0


class _Request:
    """A request's bytes and its transfer."""

    def __init__(self) -> None:
        self.bytes = ctypes.create_string_buffer(SESSION_REQUEST_BYTES)
        self.transfer: Transfer
        self.pending = False


_One = TypeVar("_One", _Read, _Request)

_abandoned: list[object] = []
"""Readers whose transfers did not end. The kernel may still write into their memory, so it is never freed."""


class AsynchronousBulkReader:
    """Keeps the reads of a plan in flight. Each is asked for by a request, unless the bridge is in stream mode."""

    def __init__(
        self,
        context: UsbContext,
        buffers: Buffers,
        requests: SessionRequests | None = None,
        most_requests: int = MOST_REQUESTS,
    ) -> None:
        """`requests` None: the bridge is in stream mode."""
        self._context = context
        self._buffers = buffers
        self._callback = Callback(self._completed)
        self._by_address: dict[int, _Read | _Request] = {}
        self._reads = [self._new_read(row) for row in buffers.rows]
        self._free_requests: list[_Request] = []
        self._requests = requests
        self._most_requests = most_requests
        self._unasked: deque[_Read] = deque()
        """Reads in flight whose requests wait until the bridge holds fewer."""
        self._queue: deque[_Read] = deque()
        self._unsubmitted: list[_Read] = []
        self._current: _Read | None = None
        self._in_flight = 0
        self._completions = 0
        self._underrun: int | None = None
        self._running = False
        self._request_error: TransferError | None = None

    @property
    def in_flight_bytes(self) -> int:
        """See `BulkReader`."""
        return len(self._reads) * self._buffers.plan.transfer_bytes

    def underrun_bytes(self) -> int | None:
        """See `BulkReader`."""
        return self._underrun

    def start(self) -> None:
        """See `BulkReader`. If the kernel takes fewer transfers than planned, but MIN_TRANSFERS, those are used."""
        self._running = True
        self._request_error = None
        self._unsubmitted.clear()
        self._unasked.clear()
        for number, read in enumerate(self._reads):
            try:
                self._submit(read)
            except OutOfUsbMemoryError:
                if number < MIN_TRANSFERS:
                    raise
                for surplus in self._reads[number:]:
                    self._free(surplus)
                del self._reads[number:]
                break

    def next(self, timeout_s: float) -> CompletedTransfer | None:
        """See `BulkReader`."""
        if not self._queue:
            return None
        self._wait(timeout_s)
        if self._queue[0].pending:
            error, self._request_error = self._request_error, None
            return CompletedTransfer(self._queue[0].buffer[:0], error) if error else None
        read = self._current = self._queue.popleft()
        self._ask_for_more()
        status = TransferStatus(read.transfer.status)
        return CompletedTransfer(read.buffer[: read.transfer.actual_length], _ERRORS.get(status), read.seen_ns)

    def release(self) -> None:
        """See `BulkReader`. Raises usb.core.USBError, or OutOfUsbMemoryError if no read can be queued any more."""
        read, self._current = self._current, None
        self._underrun = None
        if read is None or not self._running:
            return
        self._reap()
        if not self._in_flight:
            self._underrun = self._completed_bytes(len(self._queue))
        self._unsubmitted.append(read)
        queued = len(self._queue)
        try:
            while self._unsubmitted:
                self._submit(self._unsubmitted[-1])
                self._unsubmitted.pop()
        except OutOfUsbMemoryError:
            if not self._queue:
                raise
        self._reap()
        # All earlier reads may have completed before the new ones were queued. Bytes of the new ones came after that.
        if self._underrun is None and self._in_flight <= len(self._queue) - queued and queued:
            self._underrun = self._completed_bytes(queued)

    def stop(self, timeout_s: float) -> bool:
        """See `BulkReader`."""
        self._running = False
        pending = [one for one in self._by_address.values() if one.pending]
        # Last first: otherwise the camera fills a later read after an earlier one is cancelled, and bytes are lost.
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
        """See `BulkReader`."""
        if any(one.pending for one in self._by_address.values()):
            _abandoned.append(self)
            return False
        for one in list(self._by_address.values()):
            self._free(one)
        self._reads.clear()
        self._free_requests.clear()
        self._queue.clear()
        return True

    def _completed_bytes(self, count: int) -> int:
        """Bytes of those of the oldest `count` reads that have completed."""
        return sum(read.transfer.actual_length for read in islice(self._queue, count) if not read.pending)

    def _new_read(self, buffer: NDArray[np.uint8]) -> _Read:
        transfer = self._context.allocate(DATA_IN, buffer.ctypes.data, buffer.size, self._callback)
        return self._register(_Read(buffer, transfer))

    def _new_request(self) -> _Request:
        request = _Request()
        request.transfer = self._context.allocate(
            SESSION_OUT, ctypes.addressof(request.bytes), SESSION_REQUEST_BYTES, self._callback
        )
        return self._register(request)

    def _register(self, one: _One) -> _One:
        self._by_address[ctypes.addressof(one.transfer)] = one
        return one

    def _free(self, one: _Read | _Request) -> None:
        del self._by_address[ctypes.addressof(one.transfer)]
        self._context.free(one.transfer)

    def _submit(self, read: _Read) -> None:
        """Send the request before the read, so that the bridge has the data when the read arrives."""
        held = self._in_flight - len(self._unasked)
        wait = self._requests is not None and held >= self._most_requests
        if self._requests is not None and not wait:
            self._ask_for(read, self._requests)
        self._send(read)
        if wait:
            self._unasked.append(read)
        self._queue.append(read)
        self._in_flight += 1

    def _ask_for(self, read: _Read, requests: SessionRequests) -> None:
        request = self._free_requests.pop() if self._free_requests else self._new_request()
        request.bytes.raw = requests.encode(SessionCommand.READ, read.buffer.size)
        try:
            self._send(request)
        except BaseException:
            self._free_requests.append(request)
            raise

    def _ask_for_more(self) -> None:
        """Send the requests for which the bridge has room by now. Raises usb.core.USBError."""
        while self._running and self._unasked and self._in_flight - len(self._unasked) < self._most_requests:
            assert self._requests is not None
            self._ask_for(self._unasked[0], self._requests)
            self._unasked.popleft()

    def _send(self, one: _Read | _Request) -> None:
        one.pending = True
        try:
            self._context.submit(one.transfer)
        except BaseException:
            one.pending = False
            raise

    def _wait(self, timeout_s: float) -> None:
        """Wait until the oldest read has completed."""
        deadline = time.monotonic() + timeout_s
        while self._queue[0].pending and self._request_error is None:
            remaining_s = deadline - time.monotonic()
            # At least once: the process may have been suspended since the deadline was set.
            self._context.handle_events(max(0.0, remaining_s))
            if remaining_s <= 0:
                return

    def _reap(self) -> None:
        """Handle all completed transfers; libusb handles a limited number in one call."""
        handled = -1
        while handled != self._completions:
            handled = self._completions
            self._context.handle_events(0)

    def _completed(self, address: int) -> None:
        """Callback of libusb: must not raise, and must return soon."""
        one = self._by_address[address]
        one.pending = False
        self._completions += 1
        if isinstance(one, _Request):
            self._free_requests.append(one)
            if one.transfer.status != TransferStatus.COMPLETED and self._running:
                self._request_error = _ERRORS.get(TransferStatus(one.transfer.status), TransferError.FAILED)
        else:
            one.seen_ns = time.monotonic_ns()
            self._in_flight -= 1


class SynchronousBulkReader:
    """One read at a time by pyusb. Nothing is queued between two reads, so any delay of the host loses frames."""

    def __init__(self, device: usb.core.Device, plan: TransferPlan, requests: SessionRequests | None = None) -> None:
        """`requests` None: the bridge is in stream mode."""
        self._device = device
        self._buffer = array.array("B", bytes(plan.transfer_bytes))
        self._view = np.frombuffer(self._buffer, np.uint8)
        self._requests = requests
        self._requested_bytes = 0
        self._running = False

    @property
    def in_flight_bytes(self) -> int:
        """See `BulkReader`."""
        return len(self._buffer)

    def underrun_bytes(self) -> int | None:
        """See `BulkReader`. No read is ever queued between two reads."""
        return 0

    def start(self) -> None:
        """See `BulkReader`."""
        self._requested_bytes = 0
        self._running = True

    def next(self, timeout_s: float) -> CompletedTransfer | None:
        """See `BulkReader`."""
        if not self._running:
            return None
        try:
            if self._requests is not None and not self._requested_bytes:
                request = self._requests.encode(SessionCommand.READ, self._view.size)
                self._device.write(SESSION_OUT, request, _REQUEST_TIMEOUT_MS)
                self._requested_bytes = self._view.size
            timeout_ms = max(1, round(1e3 * timeout_s))
            size = self._device.read(DATA_IN, self._buffer, timeout_ms)
        except usb.core.USBTimeoutError:
            return None  # no byte came, so the request remains valid
        except usb.core.USBError as error:
            self._requested_bytes = 0
            return CompletedTransfer(self._view[:0], transfer_error_of(error))
        self._requested_bytes = 0
        return CompletedTransfer(self._view[:size])

    def release(self) -> None:
        """See `BulkReader`."""

    def stop(self, timeout_s: float) -> bool:
        """See `BulkReader`."""
        self._running = False
        return True

    def close(self) -> bool:
        """See `BulkReader`."""
        return True


def transfer_error_of(error: usb.core.USBError) -> TransferError:
    """Class of a failed call of pyusb. Unplugging has several error numbers; sysfs shows whether the camera is gone."""
    return _BY_NUMBER.get(error.errno or 0, TransferError.FAILED)
