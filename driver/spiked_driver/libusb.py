"""What pyusb does not offer of libusb: a context of one's own, and transfers that run while we do something else.

The only module that leans on private parts of pyusb (its context, its open handle and its loaded library), and the
reason why the version is pinned. Layouts and codes are those of libusb 1.0's public header.
"""

import ctypes
import time
from collections.abc import Callable
from enum import IntEnum
from functools import cache
from typing import Any

import usb.backend.libusb1
import usb.core
import usb.libloader

from spiked.errors import SourceError
from spiked_driver.usb_cameras import UsbCamera

Callback = ctypes.CFUNCTYPE(None, ctypes.c_void_p)
_NO_MEMORY = -11
_BULK = 2
_ATTEMPTS = 5
_AGAIN_S = 0.02


class Status(IntEnum):
    """How a transfer ended (enum libusb_transfer_status)."""

    COMPLETED = 0
    ERROR = 1
    TIMED_OUT = 2
    CANCELLED = 3
    STALL = 4
    NO_DEVICE = 5
    OVERFLOW = 6


class Transfer(ctypes.Structure):
    """struct libusb_transfer, as far as bulk transfers use it."""

    _fields_ = (
        ("dev_handle", ctypes.c_void_p),
        ("flags", ctypes.c_uint8),
        ("endpoint", ctypes.c_uint8),
        ("type", ctypes.c_uint8),
        ("timeout", ctypes.c_uint),
        ("status", ctypes.c_int),
        ("length", ctypes.c_int),
        ("actual_length", ctypes.c_int),
        ("callback", Callback),
        ("user_data", ctypes.c_void_p),
        ("buffer", ctypes.c_void_p),
        ("num_iso_packets", ctypes.c_int),
    )

    status: int
    actual_length: int


class _Timeval(ctypes.Structure):
    _fields_ = (("seconds", ctypes.c_long), ("microseconds", ctypes.c_long))


class OutOfUsbMemoryError(SourceError):
    """The kernel takes no more transfers: its limit is reached."""


class NoContextError(SourceError):
    """libusb is there but cannot begin now: it may in a moment."""


@cache
def load_libusb() -> Any:
    """The library, prepared by pyusb. Raises SourceError if it is not installed.

    pyusb's own `get_backend` answers None for every trouble, that of a moment too, and makes a context that nobody
    uses.
    """
    try:
        library = usb.backend.libusb1._load_library()
    except usb.libloader.LibraryException as error:
        raise SourceError(
            f"libusb 1.0 is not installed ({error}): install it (Debian: apt install libusb-1.0-0)"
        ) from error
    usb.backend.libusb1._setup_prototypes(library)
    usb.backend.libusb1._lib = library  # where pyusb looks for the texts of errors
    return library


class UsbContext:
    """A libusb context with nothing in it but one camera.

    Each is made anew, since a context learns of plugging only where udev runs, which it does not in most containers.
    """

    def __init__(self) -> None:
        """Raises SourceError if there is no libusb, NoContextError if it does not begin, after a few attempts."""
        self._lib: Any = load_libusb()
        self._backend: Any = _begun(self._lib)
        self._device: usb.core.Device | None = None
        self._submit = self._function("libusb_submit_transfer", ctypes.c_int, ctypes.c_void_p)
        self._cancel = self._function("libusb_cancel_transfer", ctypes.c_int, ctypes.c_void_p)
        self._allocate = self._function("libusb_alloc_transfer", ctypes.c_void_p, ctypes.c_int)
        self._free = self._function("libusb_free_transfer", None, ctypes.c_void_p)
        self._handle_events = self._function(
            "libusb_handle_events_timeout_completed",
            ctypes.c_int,
            ctypes.c_void_p,
            ctypes.POINTER(_Timeval),
            ctypes.c_void_p,
        )

    def find(self, camera: UsbCamera) -> usb.core.Device | None:
        """pyusb's device for a camera, None if it is gone."""
        self._device = usb.core.find(backend=self._backend, bus=camera.bus, address=camera.address)
        return self._device

    def allocate(self, endpoint: int, buffer: int, length: int, callback: Any) -> Transfer:
        """A bulk transfer from or to that many bytes at address `buffer`, without a time limit, for the open device.

        `callback` is called with the transfer's address, in `handle_events`.
        """
        assert self._device is not None, "a camera was found"
        address = self._allocate(0)
        if not address:
            raise MemoryError("libusb has no memory for a transfer")
        transfer = Transfer.from_address(address)
        transfer.dev_handle = self._device._ctx.handle.handle
        transfer.endpoint, transfer.type, transfer.timeout = endpoint, _BULK, 0
        transfer.buffer, transfer.length, transfer.callback = buffer, length, callback
        return transfer

    def free(self, transfer: Transfer) -> None:
        """Let go of a transfer that is not in flight."""
        self._free(ctypes.addressof(transfer))

    def submit(self, transfer: Transfer) -> None:
        """Queue it. Raises usb.core.USBError, or OutOfUsbMemoryError."""
        code = self._submit(ctypes.addressof(transfer))
        if code == _NO_MEMORY:
            raise OutOfUsbMemoryError("the kernel takes no more USB transfers (NO_MEM)")
        usb.backend.libusb1._check(code)

    def cancel(self, transfer: Transfer) -> None:
        """Ask for its end, which comes as a callback; fine if it is not in flight."""
        self._cancel(ctypes.addressof(transfer))

    def handle_events(self, timeout_s: float) -> None:
        """Let callbacks happen: wait for the first so long, and return after it."""
        wait = _Timeval(int(timeout_s), int(1e6 * (timeout_s % 1)))
        usb.backend.libusb1._check(self._handle_events(self._backend.ctx, ctypes.byref(wait), None))

    def close(self) -> None:
        """Close the device and the context, in this order; pyusb by itself may do it in the other."""
        if self._device is not None:
            usb.util.dispose_resources(self._device)
            self._device._ctx.dev.finalize()
            self._device = None
        self._backend.finalize()

    def _function(self, name: str, result: Any, *arguments: Any) -> Callable[..., Any]:
        """A function object of our own: argument types set on pyusb's would be pyusb's too."""
        function: Callable[..., Any] = ctypes.CFUNCTYPE(result, *arguments)((name, self._lib))
        return function


def _begun(library: Any) -> Any:
    """pyusb's backend with a new context: where udev is just telling others of cameras, beginning can fail once."""
    for attempt in range(_ATTEMPTS):
        try:
            return usb.backend.libusb1._LibUSB(library)
        except usb.core.USBError as error:
            if attempt == _ATTEMPTS - 1:
                raise NoContextError(f"libusb does not begin: {error.strerror}") from error
            time.sleep(_AGAIN_S * (attempt + 1))
    raise AssertionError("unreachable")
