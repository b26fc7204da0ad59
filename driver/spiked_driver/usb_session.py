"""One open camera: claimed interfaces, the bridge's configuration, and the reader of its stream."""

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
    SessionCommand,
    SessionMode,
    SessionRequests,
)
from spiked_driver.libusb import NoContextError, UsbContext
from spiked_driver.transfers import MOST_REQUESTS, AsynchronousBulkReader, Buffers, BulkReader, SynchronousBulkReader
from spiked_driver.usb_cameras import NotUsableError, UsbCamera

_log = logging.getLogger(__name__)
_CONTROL_TIMEOUT_MS = 500
"""Time for the answer to a control request, ms."""
_COMMAND_TIMEOUT_MS = 50
"""Time for a session request of 20 bytes to be taken, ms."""


class NotThereError(SourceError):
    """The camera is unplugged or does not answer; a later attempt may succeed."""


class UsbSession:
    """A camera from opening to closing. Used by one thread."""

    def __init__(
        self,
        camera: UsbCamera,
        buffers: Buffers,
        *,
        mode: SessionMode = SessionMode.REQUEST,
        asynchronous: bool = True,
        most_requests: int = MOST_REQUESTS,
    ) -> None:
        """Open the camera; `start` starts reading. Raises NotUsableError or NotThereError."""
        self.camera = camera
        self.mode = mode
        self._requests = SessionRequests()
        self._started = False
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
            self._transfer_bytes = buffers.plan.transfer_bytes
            requests = self._requests if mode is SessionMode.REQUEST else None
            self.reader: BulkReader = (
                AsynchronousBulkReader(self._context, buffers, requests, most_requests)
                if asynchronous
                else SynchronousBulkReader(self._device, buffers.plan, requests)
            )
        except usb.core.USBError as error:
            self._context.close()
            raise self._error_of(error) from error
        except BaseException:
            self._context.close()
            raise

    def start(self) -> None:
        """Put the bridge into its mode and queue the reads. Raises usb.core.USBError, or OutOfUsbMemoryError."""
        if self.mode is SessionMode.STREAM:
            self._command(SessionCommand.ABORT)
            self._command(SessionCommand.STREAM, self._transfer_bytes)
        self._started = True
        self.reader.start()

    def rearm(self) -> None:
        """After `reader.stop`: clear a stall of both endpoints and queue the reads again. Raises usb.core.USBError."""
        self._device.clear_halt(DATA_IN)
        self._device.clear_halt(SESSION_OUT)
        self._command(SessionCommand.ABORT)
        self._command(SessionCommand.FLUSH)
        self.start()

    def reset(self) -> None:
        """Reset the port. The camera must be opened again afterwards."""
        with suppress(usb.core.USBError):  # the camera may get another address
            self._device.reset()

    def close(self, timeout_s: float) -> None:
        """End all transfers and close. If some do not end in time, their memory is kept and the camera stays open."""
        ended = self.reader.stop(timeout_s)
        if ended and self._started:  # a fresh handle is left as it is
            self._end_session()
        if self.reader.close() and ended:
            self._context.close()
        else:
            _log.warning("transfers of the camera at %s did not end: the camera stays open", self.camera.port)

    def _end_session(self) -> None:
        """Abort and flush; a bridge that refuses that is told in the log, unless the camera is gone."""
        try:
            self._command(SessionCommand.ABORT)
            self._command(SessionCommand.FLUSH)
        except usb.core.USBError as error:
            if error.errno != errno.ENODEV:
                _log.info("the bridge of the camera at %s refuses abort or flush: %s", self.camera.port, error)

    def _command(self, command: SessionCommand, length: int = 0) -> None:
        """Send a session request while no read is in flight. Raises usb.core.USBError."""
        self._device.write(SESSION_OUT, self._requests.encode(command, length), _COMMAND_TIMEOUT_MS)

    def _open(self) -> usb.core.Device:
        device = self._context.find(self.camera)
        if device is None:
            raise NotThereError(f"the camera at {self.camera.port} is unplugged")
        for interface in (SESSION_INTERFACE, DATA_INTERFACE):
            with suppress(NotImplementedError):
                if device.is_kernel_driver_active(interface):
                    device.detach_kernel_driver(interface)
            usb.util.claim_interface(device, interface)
        return device

    def _read_configuration(self) -> ChipConfiguration | None:
        """None if the bridge does not answer as public drivers of the FT601 describe; reading works without it."""
        try:
            return _request_configuration(self._device)
        except usb.core.USBError as error:
            if error.errno == errno.ENODEV:
                raise
            _log.warning(
                "the bridge of the camera at %s does not return its configuration: %s", self.camera.port, error
            )
        except SourceError as error:
            _log.warning("%s", error)
        return None

    def _error_of(self, error: usb.core.USBError) -> SourceError:
        where = f"the camera at {self.camera.port}"
        match error.errno:
            case errno.EACCES | errno.EPERM:
                return NotUsableError(
                    self.camera.permission_problem() or f"{where} may not be opened: {error.strerror}"
                )
            case errno.EBUSY:
                return NotUsableError(f"{where} is used by another program or capture: end it first")
            case _:
                return NotThereError(f"{where} cannot be opened: {error.strerror}")


def bridge_configuration(camera: UsbCamera) -> ChipConfiguration:
    """The configuration of a camera's bridge, also while the camera is being read. Raises SourceError."""
    context = UsbContext()
    try:
        device = context.find(camera)
        if device is None:
            raise NotThereError(f"the camera at {camera.port} is unplugged")
        return _request_configuration(device)
    except usb.core.USBError as error:
        raise SourceError(f"the bridge of the camera at {camera.port} does not answer: {error.strerror}") from error
    finally:
        context.close()


def _request_configuration(device: usb.core.Device) -> ChipConfiguration:
    """Raises USBError or SourceError."""
    answer = device.ctrl_transfer(
        REQUEST_TYPE, REQUEST_CONFIGURATION, REQUEST_VALUE, REQUEST_INDEX, CONFIGURATION_BYTES, _CONTROL_TIMEOUT_MS
    )
    return ChipConfiguration.parse(bytes(answer))
