"""One opened camera: its interfaces claimed, its bridge's configuration read, its reads queued."""

import errno
import logging
from contextlib import suppress

import usb.core
import usb.util

from spiked.errors import SourceError
from spiked_driver.ft60x import (
    CONFIGURATION_BYTES,
    DATA_IN,
    DATA_INTERFACE,
    REQUEST_CONFIGURATION,
    REQUEST_INDEX,
    REQUEST_TYPE,
    REQUEST_VALUE,
    SESSION_INTERFACE,
    SESSION_OUT,
    ChipConfiguration,
)
from spiked_driver.libusb import NoContextError, UsbContext
from spiked_driver.transfers import AsynchronousReads, Buffers, Reads, SynchronousReads
from spiked_driver.usb_cameras import NotUsableError, UsbCamera

_log = logging.getLogger(__name__)
_CONTROL_MS = 500


class NotThereError(SourceError):
    """The camera is not there, or does not answer: it may be back in a moment."""


class UsbSession:
    """From opening to closing of one camera. Used by one thread."""

    def __init__(self, camera: UsbCamera, buffers: Buffers, *, asynchronous: bool = True) -> None:
        """Opens it; nothing is read before `reads.start`. Raises NotUsableError or NotThereError."""
        self.camera = camera
        problem = camera.speed_problem() or camera.permission_problem()
        if problem:
            raise NotUsableError(problem)
        try:
            self._context = UsbContext()
        except NoContextError as error:
            raise NotThereError(f"the camera at {camera.port} cannot be opened: {error}") from error
        try:
            self._device = self._open()
            self.chip = self._read_configuration()
            self.reads: Reads = (
                AsynchronousReads(self._context, buffers)
                if asynchronous
                else SynchronousReads(self._device, buffers.plan)
            )
        except usb.core.USBError as error:
            self._context.close()
            raise self._explained(error) from error
        except BaseException:
            self._context.close()
            raise

    def rearm(self) -> None:
        """After `reads.stop`: clear a stall of both endpoints and queue the reads again. Raises usb.core.USBError."""
        self._device.clear_halt(DATA_IN)
        self._device.clear_halt(SESSION_OUT)
        self.reads.start()

    def reset(self) -> None:
        """Reset its port, after which it must be opened again."""
        with suppress(usb.core.USBError):  # it may come back under another address: then this one is gone
            self._device.reset()

    def close(self, timeout_s: float) -> None:
        """End all transfers and close; if some do not end in time, their memory and the open camera are left alone."""
        ended = self.reads.stop(timeout_s)
        if self.reads.close() and ended:
            self._context.close()
        else:
            _log.warning("transfers of the camera at %s did not end: it stays open", self.camera.port)

    def _open(self) -> usb.core.Device:
        device = self._context.find(self.camera)
        if device is None:
            raise NotThereError(f"the camera at {self.camera.port} is gone")
        for interface in (SESSION_INTERFACE, DATA_INTERFACE):
            with suppress(NotImplementedError):
                if device.is_kernel_driver_active(interface):
                    device.detach_kernel_driver(interface)
            usb.util.claim_interface(device, interface)
        return device

    def _read_configuration(self) -> ChipConfiguration | None:
        """None where the bridge does not answer as the FT601 is said to: reading works without."""
        try:
            answer = self._device.ctrl_transfer(
                REQUEST_TYPE, REQUEST_CONFIGURATION, REQUEST_VALUE, REQUEST_INDEX, CONFIGURATION_BYTES, _CONTROL_MS
            )
            return ChipConfiguration.parse(bytes(answer))
        except usb.core.USBError as error:
            if error.errno == errno.ENODEV:
                raise
            _log.warning("the bridge of the camera at %s does not tell its configuration: %s", self.camera.port, error)
        except SourceError as error:
            _log.warning("%s", error)
        return None

    def _explained(self, error: usb.core.USBError) -> SourceError:
        where = f"the camera at {self.camera.port}"
        match error.errno:
            case errno.EACCES | errno.EPERM:
                return NotUsableError(
                    self.camera.permission_problem() or f"{where} may not be opened: {error.strerror}"
                )
            case errno.EBUSY:
                return NotUsableError(f"{where} is used by another program or capture: end that first")
            case _:
                return NotThereError(f"{where} cannot be opened: {error.strerror}")
