"""Parts of libusb that pyusb does not offer: a context for each camera, and asynchronous transfers.

This is the only module that uses private parts of pyusb (its context, open handle and loaded library); pyusb's version
is pinned because of it. Layouts and codes are those of libusb 1.0's public header, libusb.h.
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
_INTERRUPTED = -10
"""LIBUSB_ERROR_INTERRUPTED."""
_NO_MEMORY = -11
"""LIBUSB_ERROR_NO_MEM."""
_BULK = 2
"""LIBUSB_TRANSFER_TYPE_BULK."""
_ATTEMPTS = 5
"""Attempts to make a libusb context."""
_RETRY_S = 0.02
"""Pause after the first failed attempt, seconds; it grows by as much with each."""


class TransferStatus(IntEnum):
    """How a transfer ended (enum libusb_transfer_status)."""

    COMPLETED = 0
    ERROR = 1
    TIMED_OUT = 2
    CANCELLED = 3
    STALL = 4
    NO_DEVICE = 5
    OVERFLOW = 6


class Transfer(ctypes.Structure):
    """struct libusb_transfer without its isochronous packets."""

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
    """The kernel takes no more transfers: its memory limit is reached."""


class NoContextError(SourceError):
    """libusb is installed but cannot be initialised now; a later attempt may succeed."""


@cache
def load_libusb() -> Any:
    """The libusb library with pyusb's prototypes. Raises SourceError if it is not installed.

    pyusb's own `get_backend` returns None for every error, including temporary ones, and makes an unused context.
    """
    try:
        library = usb.backend.libusb1._load_library()
    except usb.libloader.LibraryException as error:
        raise SourceError(
            f"libusb 1.0 is not installed ({error}): install it (Debian: apt install libusb-1.0-0)"
        ) from error
    usb.backend.libusb1._setup_prototypes(library)
    usb.backend.libusb1._lib = library  # pyusb takes the texts of errors from there
    return library


class UsbContext:
    """A libusb context for one camera.

    A new one is made for each opening: a context notices new devices only where udev runs, and not in most containers.
    """

    def __init__(self) -> None:
        """Raises SourceError if libusb is not installed, NoContextError if it cannot be initialised."""
        self._lib: Any = load_libusb()
        self._backend: Any = _new_backend(self._lib)
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
        """pyusb's device of a camera; None if it is unplugged."""
        self._device = usb.core.find(backend=self._backend, bus=camera.bus, address=camera.address)
        return self._device

    def allocate(self, endpoint: int, buffer: int, length: int, callback: Any) -> Transfer:
        """A bulk transfer of the open device without a time limit; `buffer` is the address of `length` bytes.

        `handle_events` calls `callback` with the transfer's address.
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
        """Free a transfer that is not in flight."""
        self._free(ctypes.addressof(transfer))

    def submit(self, transfer: Transfer) -> None:
        """Queue a transfer. Raises usb.core.USBError or OutOfUsbMemoryError."""
        code = self._submit(ctypes.addressof(transfer))
        if code == _NO_MEMORY:
            raise OutOfUsbMemoryError("the kernel takes no more USB transfers (NO_MEM)")
        usb.backend.libusb1._check(code)

    def cancel(self, transfer: Transfer) -> None:
        """Cancel a transfer; its callback follows. A transfer that is not in flight is no error."""
        self._cancel(ctypes.addressof(transfer))

    def handle_events(self, timeout_s: float) -> None:
        """Run the callbacks of completed transfers; wait at most `timeout_s` for the first."""
        wait = _Timeval(int(timeout_s), int(1e6 * (timeout_s % 1)))
        code = self._handle_events(self._backend.ctx, ctypes.byref(wait), None)
        if code != _INTERRUPTED:  # a signal came: no transfer has failed
            usb.backend.libusb1._check(code)

    def close(self) -> None:
        """Close the device, then the context. pyusb's own finalisers may run in the other order."""
        if self._device is not None:
            usb.util.dispose_resources(self._device)
            self._device._ctx.dev.finalize()
            self._device = None
        self._backend.finalize()

    def _function(self, name: str, result: Any, *arguments: Any) -> Callable[..., Any]:
        """A separate function object: argument types set on pyusb's object would change pyusb's calls as well."""
        function: Callable[..., Any] = ctypes.CFUNCTYPE(result, *arguments)((name, self._lib))
        return function


def _new_backend(library: Any) -> Any:
    """pyusb's backend with a new context. Initialisation can fail while udev reports new devices to other programs."""
    for attempt in range(_ATTEMPTS):
        try:
            return usb.backend.libusb1._LibUSB(library)
        except usb.core.USBError as error:
            if attempt == _ATTEMPTS - 1:
                raise NoContextError(f"libusb cannot be initialised: {error.strerror}") from error
            time.sleep(_RETRY_S * (attempt + 1))
    raise AssertionError("unreachable")
