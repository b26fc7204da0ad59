"""The USB3 camera as a source: it is waited for, read, lost and found again."""

import logging
import time
from dataclasses import dataclass
from enum import Enum, auto

import numpy as np
import usb.core
from numpy.typing import NDArray

from spiked.errors import SourceError
from spiked.ring import Cause, Condition, DeviceState, End, Gap
from spiked.sensor import Intrinsics, Sensor
from spiked_driver.framing import USB_FRAME_BYTES, USB_HEIGHT, USB_WIDTH, FramingCounters, UsbFraming
from spiked_driver.libusb import OutOfUsbMemoryError
from spiked_driver.source import READ_WAIT_S, Chunk
from spiked_driver.transfers import Arrival, Buffers, Trouble, trouble_of
from spiked_driver.usb_budget import TRANSFER_BYTES, TransferPlan, plan_transfers, usbfs_limit
from spiked_driver.usb_cameras import CameraChoice, NotUsableError, UsbCamera, find_cameras
from spiked_driver.usb_session import NotThereError, UsbSession

_log = logging.getLogger(__name__)

RATE_HZ = 20_000.0
SILENCE_S = 1.0
"""The camera free-runs: when nothing came for so long, something is wrong."""
_PATIENCE = 16
"""A camera that stays silent is left alone for longer each time, up to so many times the first: it may be starting."""
_DRAIN_S = 0.4
"""For transfers to end when a capture is stopped, which has a second in all."""
_LOOK_S = 1.0
"""How often to see which other cameras there are."""
_DRY_FRAMES = 16
"""What lies in the camera and its bridge when nothing is queued, at most: frames it drops come after those."""


@dataclass(frozen=True)
class UsbOptions:
    """How a USB camera is read."""

    rate_hz: float = RATE_HZ
    intrinsics: Intrinsics | None = None
    hide_s: float | None = None
    """How long the host may be busy without a loss; None: as long as fits, at most a default."""
    transfer_bytes: int = TRANSFER_BYTES
    asynchronous: bool = True
    """False: pyusb's own reads, one at a time, for machines where queued ones do not work."""
    silence_s: float = SILENCE_S


class _Phase(Enum):
    """What is done with the camera now."""

    LOOKING = auto()
    """There is no open camera."""
    READING = auto()
    EMPTYING = auto()
    """Reading broke off: what had come before is still taken."""


class UsbSource:
    """A 400x250 camera behind an FT601. It may come late, go away and come back: a state and a gap, not an error."""

    def __init__(self, choice: CameraChoice, options: UsbOptions | None = None) -> None:
        self.choice = choice
        self.options = options or UsbOptions()
        self._sensor = Sensor(USB_WIDTH, USB_HEIGHT, self.options.rate_hz, intrinsics=self.options.intrinsics)
        self._framing = UsbFraming()
        self._buffers: Buffers | None = None
        self._session: UsbSession | None = None
        self._phase = _Phase.LOOKING
        self._camera: UsbCamera | None = None
        self._others: set[str] = set()
        self._looked_s = 0.0
        self._trouble: Trouble | None = None
        self._attempts = 0
        self._break: Cause | None = None
        self._replugged = False  # the camera was without power in the break
        self._heard_s = 0.0  # when bytes came last
        self._waiting_since_s = 0.0
        self._dry: tuple[int, int] | None = None  # bytes of the stream that had come when nothing was queued
        self._note = ""
        self._condition = Condition(DeviceState.IDLE)

    @property
    def sensor(self) -> Sensor:
        """400x250, rows as the camera sends them."""
        return self._sensor

    @property
    def frames(self) -> int | None:
        """There is no end."""
        return None

    @property
    def waits(self) -> bool:
        """A camera never waits."""
        return False

    @property
    def condition(self) -> Condition:
        """Absent until there is a camera, armed once its reads are queued, streaming with its frames, lost after."""
        return self._condition

    @property
    def camera(self) -> UsbCamera | None:
        """The camera that is read, or was when it was lost."""
        return self._camera

    @property
    def plan(self) -> TransferPlan:
        """What is queued. Raises SourceError for more than the kernel allows."""
        if self._buffers is not None:
            return self._buffers.plan
        rate_bytes = USB_FRAME_BYTES * self.options.rate_hz
        return plan_transfers(
            rate_bytes, usbfs_limit(), hide_s=self.options.hide_s, transfer_bytes=self.options.transfer_bytes
        )

    @property
    def counters(self) -> FramingCounters:
        """What was made of the bytes so far."""
        return self._framing.counters

    def open(self) -> None:
        """Look for the camera and queue its reads; fine if it is not there yet.

        Raises SourceError if it is there and cannot be used, or if the plan exceeds what the kernel allows.
        """
        self.close()
        self._framing = UsbFraming()
        self._buffers = Buffers(self.plan)
        self._note = ""
        if self.plan.note:
            hides_ms = 1e3 * self.plan.hides_s
            self._warn(self.plan.note, f"hides only {hides_ms:.0f} ms of a busy host: see `spiked devices --doctor`")
        self._camera, self._break, self._replugged, self._dry = None, None, False, None
        self._others.clear()
        self._look(first=True)

    def close(self) -> None:
        """End all transfers and let go of the camera, within a moment."""
        self._disconnect()
        self._condition = Condition(DeviceState.IDLE)

    def read_into(self, view: NDArray[np.uint8]) -> Chunk | Gap | End | None:
        """See `Source.read_into`."""
        if self._buffers is None:
            raise SourceError(f"the camera {self.choice} is not open: open it before reading")
        while (item := self._framing.read_into(view)) is None:
            if not self._receive():
                return None
        if isinstance(item, Gap):
            return self._attributed(item)
        if self._phase is _Phase.READING:
            self._condition = Condition(DeviceState.STREAMING, self._note)
            self._attempts = 0
        return item

    def _receive(self) -> bool:
        """Get the next bytes, or get on with finding the camera; false where a caller should have a look around."""
        match self._phase:
            case _Phase.LOOKING:
                self._look()
                if self._session is None:
                    time.sleep(READ_WAIT_S)
                return False
            case _Phase.READING:
                return self._read()
            case _Phase.EMPTYING:
                return self._empty()

    def _read(self) -> bool:
        assert self._session is not None
        reads = self._session.reads
        self._framing.keep()
        try:
            reads.release()
            if (waiting := reads.ran_dry()) is not None:
                ended_at = self._framing.counters.bytes + waiting
                self._dry = (self._dry[0] if self._dry else ended_at, ended_at)
            arrival = reads.next(READ_WAIT_S)
        except usb.core.USBError as error:
            self._break_off(trouble_of(error))
            return False
        now_s = time.monotonic()
        if arrival is None:
            limit_s = self.options.silence_s * min(_PATIENCE, 1 << min(self._attempts, 8))
            if now_s - max(self._heard_s, self._waiting_since_s) > limit_s:
                self._break_off(None)
            return False
        if now_s - self._looked_s > _LOOK_S:
            self._look_around(find_cameras())
        self._take(arrival, now_s)
        if arrival.trouble:
            self._break_off(arrival.trouble)
            return bool(arrival.data.size)
        return True

    def _take(self, arrival: Arrival, now_s: float) -> None:
        if not arrival.data.size:
            return
        if self._break is not None:
            self._resume(arrival.data.size, now_s)
        self._heard_s = now_s
        self._framing.feed(arrival.data)

    def _resume(self, size: int, now_s: float) -> None:
        """The first bytes after a break: tell how long it was by the clock."""
        assert self._break is not None
        rate_hz = self.options.rate_hz
        lost = max(0, round((now_s - self._heard_s) * rate_hz - size / USB_FRAME_BYTES))
        # A camera that kept its power kept its count, so any step forward is believed. One that was unplugged may count
        # anew, and is believed only if the clock agrees.
        tolerance = round(rate_hz + 0.05 * lost) if self._replugged else 1 << 31
        self._framing.resume(lost, tolerance, self._break)
        self._break = None
        self._replugged = False
        self._dry = None

    def _break_off(self, trouble: Trouble | None) -> None:
        """Stop reading; `trouble` None: the camera is silent."""
        assert self._session is not None
        assert self._camera is not None
        self._trouble = trouble
        self._condition = Condition(DeviceState.LOST, f"{trouble or 'the camera sends nothing'} ({self._camera.port})")
        _log.warning("%s", self._condition.reason)
        self._phase = _Phase.EMPTYING
        if not self._session.reads.stop(_DRAIN_S):
            self._disconnect()

    def _empty(self) -> bool:
        """Take what came before or beside the trouble; then try again."""
        assert self._session is not None
        self._framing.keep()
        self._session.reads.release()
        arrival = self._session.reads.next(0)
        if arrival is None:
            self._recover()
            return False
        if arrival.data.size:
            self._framing.mark_loss()
            self._take(arrival, time.monotonic())
        return True

    def _recover(self) -> None:
        """Read on, from the same session where that helps, else from a new one."""
        assert self._session is not None
        cameras = find_cameras()
        self._look_around(cameras)
        there = self._camera in cameras
        gone = not there or self._trouble is Trouble.GONE
        self._replugged |= gone
        self._break = self._break or (Cause.DEVICE if gone or self._trouble is None else Cause.USB)
        self._attempts += 1
        again = there and self._trouble in (None, Trouble.STALLED, Trouble.BABBLE) and self._attempts == 1
        if again and self._rearmed():
            return
        if there and self._trouble is None:
            self._session.reset()
        self._disconnect()
        time.sleep(READ_WAIT_S if self._attempts > 1 else 0)

    def _rearmed(self) -> bool:
        assert self._session is not None
        try:
            self._session.rearm()
        except (usb.core.USBError, OutOfUsbMemoryError) as error:
            _log.warning("reading again failed: %s", error)
            return False
        self._armed()
        return True

    def _armed(self) -> None:
        self._phase = _Phase.READING
        self._waiting_since_s = time.monotonic()
        self._condition = Condition(DeviceState.ARMED, self._condition.reason if self._break else "")

    def _look(self, *, first: bool = False) -> None:
        """Open the camera if it is there, and say where it stands. Raises SourceError only the `first` time."""
        try:
            camera = self._find()
            if camera is None:
                what = "was unplugged" if self._camera else "is not there"
                self._condition = Condition(DeviceState.ABSENT, f"the camera {self.choice} {what}: waiting for it")
            else:
                self._connect(camera)
        except (NotUsableError, OutOfUsbMemoryError) as error:
            self._disconnect()
            if first:
                raise
            self._condition = Condition(DeviceState.IDLE, str(error))
        except NotThereError as error:
            self._disconnect()
            self._condition = Condition(DeviceState.LOST, str(error))

    def _connect(self, camera: UsbCamera) -> None:
        """Raises NotUsableError, OutOfUsbMemoryError or NotThereError."""
        assert self._buffers is not None
        self._session = UsbSession(camera, self._buffers, asynchronous=self.options.asynchronous)
        try:
            self._session.reads.start()
        except usb.core.USBError as error:
            raise NotThereError(f"{trouble_of(error)} ({camera.port}: {error.strerror})") from error
        if self._session.reads.in_flight_bytes < self.plan.in_flight_bytes and self.options.asynchronous:
            fewer = "the kernel took fewer USB transfers than planned: other cameras use its usbfs memory too"
            self._warn(fewer, fewer)
        if self._break and camera != self._camera:  # what looked like a failed transfer was its end
            self._break, self._replugged = Cause.DEVICE, True
        self._camera = camera
        self._look_around(find_cameras())
        self._armed()

    def _look_around(self, cameras: list[UsbCamera]) -> None:
        """Remember the ports of other cameras, so that none is taken for ours when ours is gone, and it was too."""
        self._others |= {camera.port for camera in cameras if self._camera and camera.port != self._camera.port}
        self._looked_s = time.monotonic()

    def _find(self) -> UsbCamera | None:
        cameras = find_cameras()
        if self._camera is None:
            return self.choice.pick(cameras)
        return self.choice.find_again(cameras, self._camera, self._others)

    def _disconnect(self) -> None:
        session, self._session = self._session, None
        self._phase = _Phase.LOOKING
        if session is not None:
            self._framing.keep()
            session.close(_DRAIN_S)

    def _attributed(self, gap: Gap) -> Gap:
        """Frames that the camera dropped because we gave it nothing to write into are the host's loss."""
        if self._dry is None or gap.cause is not Cause.DEVICE:
            return gap
        first, last = self._dry
        position = self._framing.counters.position(USB_FRAME_BYTES)
        if position > last + _DRY_FRAMES * USB_FRAME_BYTES:
            self._dry = None
            return gap
        return Gap(gap.first, gap.count, Cause.USB) if position > first - 2 * USB_FRAME_BYTES else gap

    def _warn(self, warning: str, note: str) -> None:
        _log.warning("%s", warning)
        self._note = note
