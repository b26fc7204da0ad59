"""Connection to a USB camera: search, open, read, and recover from errors, silence and unplugging.

Its states and legal transitions are the table in `connection_state`.
"""

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import usb.core
from numpy.typing import NDArray

from spiked.camera import CameraOptions
from spiked.errors import SourceError
from spiked.ring import DeviceState, DeviceStatus, LossCause
from spiked_driver.camera_search import CameraSearch
from spiked_driver.connection_state import ConnectionState, ConnectionStateMachine
from spiked_driver.framing import USB_FRAME_BYTES
from spiked_driver.ft60x import VENDOR_ID, SessionMode
from spiked_driver.gap_attribution import StreamBreak
from spiked_driver.libusb import OutOfUsbMemoryError
from spiked_driver.source import READ_WAIT_S
from spiked_driver.source_kind import RATE_HZ
from spiked_driver.stream_watch import StreamWatch
from spiked_driver.transfers import MOST_REQUESTS, Buffers, CompletedTransfer, TransferError, transfer_error_of
from spiked_driver.usb_budget import TRANSFER_BYTES, TransferPlan
from spiked_driver.usb_cameras import CameraChoice, NotUsableError, UsbCamera
from spiked_driver.usb_session import NotThereError, UsbSession

_log = logging.getLogger(__name__)

SILENCE_S = 1.0
"""Seconds without a byte after which the camera counts as lost: it sends all the time."""
_MAX_SILENCE_FACTOR = 16
"""The limit doubles with each failed attempt, up to this factor: a camera may need long to start."""
_CANCEL_S = 0.4
"""Longest wait for cancelled transfers, seconds. Stopping a capture may take one second in all."""
_FRAMELESS_S = 1.0
"""Seconds of bytes without a frame after which the camera counts as lost."""
_NEVER_A_FRAME_S = 5.0
"""Seconds of bytes without a frame after which a capture fails that never had one."""
_MAX_DOUBLINGS = 8
"""Bounds the shift; `_MAX_SILENCE_FACTOR` is reached before."""
_REARM_AFTER = (None, TransferError.STALLED, TransferError.BABBLE)
"""Errors (None: silence) after which the open session is tried once more before it is closed."""
_OTHER_DEVICES = f"Not every {VENDOR_ID:04x}:601f is one: see `spiked devices`"


@dataclass(frozen=True)
class UsbOptions:
    """How a USB camera is read."""

    rate_hz: float = RATE_HZ
    camera: CameraOptions = field(default_factory=CameraOptions)
    """What the stream does not say of the camera, but for its rate."""
    buffer_s: float | None = None
    """Seconds the host may be busy without a loss; None: BUFFER_S, or what the kernel's limit allows."""
    transfer_bytes: int = TRANSFER_BYTES
    asynchronous: bool = True
    """False: pyusb's own reads, one at a time, for machines where queued reads do not work."""
    silence_s: float = SILENCE_S
    """Seconds without a byte after which the camera counts as lost."""
    session: SessionMode | None = None
    """How the bridge is made to send; None: read requests, and while nothing has come each mode in turn."""
    most_requests: int = MOST_REQUESTS
    """Read requests that the bridge holds at a time, at most."""

    @property
    def rate_bytes(self) -> float:
        """Bytes a second on the wire."""
        return USB_FRAME_BYTES * self.rate_hz


@dataclass(frozen=True)
class Reception:
    """Result of one step of a connection."""

    data: NDArray[np.uint8] = field(default_factory=lambda: np.empty(0, np.uint8))
    """The next bytes of the stream, uint8 [n >= 0], valid until the next step."""
    contiguous: bool = True
    """False: the host may have lost bytes before `data`."""
    underrun_bytes: int | None = None
    """If no read was queued: complete bytes that come with this and the next receptions. None: reads were queued."""
    ended_break: StreamBreak | None = None
    """The break that ends with `data`."""
    seen_ns: int = 0
    """Monotonic time, ns, at which `data` was seen to be there."""


class UsbConnection:
    """Keeps a camera connected. The camera may be absent at first, disappear and return. Used by one thread."""

    def __init__(
        self, choice: CameraChoice, options: UsbOptions, plan: TransferPlan, warn: Callable[[str], None]
    ) -> None:
        """`warn` gets one sentence for each fault that the capture survives."""
        self._options = options
        self._warn = warn
        self._buffers = Buffers(plan)
        self._search = CameraSearch(choice)
        self._watch = StreamWatch(options.rate_bytes)
        self._session: UsbSession | None = None
        self._error: TransferError | None = None
        self._attempts = 0  # to get a lost stream back, since the last delivered frame
        self._break: StreamBreak | None = None
        self._mode = options.session or SessionMode.REQUEST
        self._mode_open = options.session is None
        """No byte has come yet: the other mode may be the right one."""
        self._tried_modes = False
        self._note = ""
        if plan.note:
            _log.warning("%s", plan.note)
            self._note = f"hides only {1e3 * plan.buffered_s:.0f} ms of a busy host: see `spiked devices --doctor`"
        self._machine = ConnectionStateMachine()

    @property
    def device_status(self) -> DeviceStatus:
        """State of the device as a capture reports it, with the reason."""
        return self._machine.device_status

    @property
    def camera(self) -> UsbCamera | None:
        """The camera in use, or the last one that was."""
        return self._search.camera

    @property
    def frameless_s(self) -> float:
        """Seconds since the last frame, 0 while no bytes come."""
        return self._watch.frameless_s

    def open(self) -> None:
        """Search for the camera and queue its reads; an absent camera is no error.

        Raises SourceError if the camera is there and cannot be used.
        """
        self._machine.enter(ConnectionState.SEARCHING, self.device_status)
        try:
            self._search_once(first=True)
        except SourceError:
            self.close()
            raise

    def close(self) -> None:
        """End all transfers and close the camera, within 0.4 s. Closing twice is allowed."""
        if self._machine.state is not ConnectionState.CLOSED:
            self._disconnect(ConnectionState.CLOSED, DeviceStatus(DeviceState.IDLE))

    def receive(self, frames: int) -> Reception:
        """Do the next step: read, drain, or search. `frames` is the number of frames framed so far.

        Returns within READ_WAIT_S, or within _CANCEL_S when reading fails. Raises SourceError if the device sends
        bytes and never a frame, or if the kernel takes no reads any more.
        """
        match self._machine.state:
            case ConnectionState.CLOSED:
                raise SourceError(f"the camera {self._search.choice} is not open: open it before reading")
            case ConnectionState.SEARCHING:
                self._search_once()
                if self._session is None:
                    time.sleep(READ_WAIT_S)
                return Reception()
            case ConnectionState.DRAINING:
                return self._drain()
        return self._read(frames)

    def frame_delivered(self) -> None:
        """A frame was delivered to the capture."""
        if self._machine.state in (ConnectionState.ARMED, ConnectionState.FRAMELESS):
            self._machine.enter(ConnectionState.STREAMING, DeviceStatus(DeviceState.STREAMING, self._note))
        if self._machine.state is ConnectionState.STREAMING:
            self._attempts = 0

    def _read(self, frames: int) -> Reception:
        assert self._session is not None
        reader = self._session.reader
        underrun_bytes = None
        try:
            reader.release()
            underrun_bytes = reader.underrun_bytes()
            transfer = reader.next(READ_WAIT_S)
        except usb.core.USBError as error:
            self._break_off(transfer_error_of(error))
            return Reception(underrun_bytes=underrun_bytes)
        if transfer is None:
            self._watch.update(np.empty(0, np.uint8), frames)
            factor = min(_MAX_SILENCE_FACTOR, 1 << min(self._attempts, _MAX_DOUBLINGS))
            if self._watch.silent_s > self._options.silence_s * factor:
                self._break_off(None)
            return Reception(underrun_bytes=underrun_bytes)
        self._watch.update(transfer.data, frames)
        self._search.refresh_if_due()
        self._check_frames(frames)
        reception = self._reception(transfer, underrun_bytes=underrun_bytes)
        if transfer.error:
            self._break_off(transfer.error)
        return reception

    def _drain(self) -> Reception:
        assert self._session is not None
        self._session.reader.release()
        transfer = self._session.reader.next(0)
        if transfer is None:
            self._recover()
            return Reception()
        return self._reception(transfer, contiguous=False)

    def _reception(
        self, transfer: CompletedTransfer, *, contiguous: bool = True, underrun_bytes: int | None = None
    ) -> Reception:
        ended_break = None
        if transfer.data.size:
            ended_break, self._break = self._break, None
            self._keep_mode()
        return Reception(transfer.data, contiguous, underrun_bytes, ended_break, transfer.seen_ns)

    def _check_frames(self, frames: int) -> None:
        """Raises SourceError for a device that never sent a frame."""
        assert self.camera is not None
        frameless_s = self._watch.frameless_s
        if frameless_s < _FRAMELESS_S:
            return
        reason = f"{self.camera.port}: {self._watch.describe()}: is it an SPS10 camera?"
        if not frames and frameless_s > _NEVER_A_FRAME_S:
            raise SourceError(f"{reason} {_OTHER_DEVICES}")
        if self._machine.state is not ConnectionState.FRAMELESS:
            _log.warning("%s", reason)
            self._machine.enter(ConnectionState.FRAMELESS, DeviceStatus(DeviceState.LOST, reason))

    def _break_off(self, error: TransferError | None) -> None:
        """Stop reading. `error` None: the camera is silent."""
        assert self._session is not None
        assert self.camera is not None
        self._error = error
        reason = f"{error or 'the camera sends nothing'} ({self.camera.port})"
        if error is None and self._mode_open:
            reason = self._try_other_mode()
        _log.warning("%s", reason)
        self._machine.enter(ConnectionState.DRAINING, DeviceStatus(DeviceState.LOST, reason))
        if not self._session.reader.stop(_CANCEL_S):
            self._record_break()
            self._disconnect(ConnectionState.SEARCHING, self.device_status)

    def _try_other_mode(self) -> str:
        """Read in the other mode from the next attempt on; what is said of it."""
        assert self.camera is not None
        silent = self._mode
        self._mode = SessionMode.STREAM if silent is SessionMode.REQUEST else SessionMode.REQUEST
        said = f"the camera at {self.camera.port} sends nothing in answer to {silent}: {self._mode} is tried"
        if silent is SessionMode.STREAM:
            said = f"the camera at {self.camera.port} sends nothing in {silent}: {self._mode} are tried"
        if not self._tried_modes:
            self._warn(said)
        self._tried_modes = True
        return said

    def _keep_mode(self) -> None:
        """Bytes came: no other mode is tried from now on."""
        if not self._mode_open:
            return
        self._mode_open = False
        if self._tried_modes:
            assert self.camera is not None
            save = f"`session={self._mode.value}` saves the trial"
            self._warn(f"the camera at {self.camera.port} sends with {self._mode}: {save}")

    def _record_break(self) -> bool:
        """Note the cause of the interruption. Returns whether the camera is still plugged in."""
        there = self._search.refresh()
        gone = not there or self._error is TransferError.GONE
        if self._break is None:
            self._break = StreamBreak(LossCause.DEVICE if gone or self._error is None else LossCause.USB)
        self._break = replace(self._break, power_lost=self._break.power_lost or gone)
        self._attempts += 1
        return there

    def _recover(self) -> None:
        """Read again: in the same session where that may help, otherwise in a new one."""
        assert self._session is not None
        there = self._record_break()
        same_mode = self._session.mode is self._mode
        if there and same_mode and self._attempts == 1 and self._error in _REARM_AFTER and self._rearm():
            return
        if there and same_mode and self._error is None:
            self._session.reset()
        self._disconnect(ConnectionState.SEARCHING, self.device_status)
        time.sleep(READ_WAIT_S if self._attempts > 1 else 0)

    def _rearm(self) -> bool:
        assert self._session is not None
        try:
            self._session.rearm()
        except (usb.core.USBError, OutOfUsbMemoryError) as error:
            _log.warning("reading again failed: %s", error)
            return False
        self._enter_armed()
        return True

    def _enter_armed(self) -> None:
        reason = self.device_status.reason if self._break else ""
        self._machine.enter(ConnectionState.ARMED, DeviceStatus(DeviceState.ARMED, reason))
        self._watch.restart()

    def _search_once(self, *, first: bool = False) -> None:
        """Open the camera if it is there, and report the device's state. Raises SourceError only the `first` time."""
        try:
            camera = self._search.find()
            if camera is None:
                self._machine.report(DeviceStatus(DeviceState.ABSENT, self._search.absence_reason()))
            else:
                self._connect(camera)
        except (NotUsableError, OutOfUsbMemoryError) as error:
            self._close_session()
            if first:
                raise
            self._machine.report(DeviceStatus(DeviceState.IDLE, str(error)))
        except NotThereError as error:
            self._close_session()
            self._machine.report(DeviceStatus(DeviceState.LOST, str(error)))

    def _connect(self, camera: UsbCamera) -> None:
        """Raises NotUsableError, OutOfUsbMemoryError or NotThereError."""
        self._session = UsbSession(
            camera,
            self._buffers,
            mode=self._mode,
            asynchronous=self._options.asynchronous,
            most_requests=self._options.most_requests,
        )
        try:
            self._session.start()
        except usb.core.USBError as error:
            raise NotThereError(f"{transfer_error_of(error)} ({camera.port}: {error.strerror})") from error
        if self._session.reader.in_flight_bytes < self._buffers.plan.in_flight_bytes and self._options.asynchronous:
            self._note = "the kernel took fewer USB transfers than planned: other cameras use its usbfs memory too"
            _log.warning("%s", self._note)
        if self._break and camera != self.camera:  # a failed transfer was the first sign of unplugging
            self._break = replace(self._break, cause=LossCause.DEVICE, power_lost=True)
        if swapped := self._search.select(camera):
            if self._break:
                self._break = replace(self._break, swapped=True)
            self._warn(swapped)
        if chip := self._session.chip:
            problem = chip.impossible(self._options.rate_bytes) or chip.unusual()
            if problem:
                self._warn(f"the camera at {camera.port}: {problem}")
        self._enter_armed()

    def _disconnect(self, state: ConnectionState, status: DeviceStatus) -> None:
        self._machine.enter(state, status)
        self._close_session()

    def _close_session(self) -> None:
        session, self._session = self._session, None
        if session is not None:
            session.close(_CANCEL_S)
