"""The USB3 camera as a source."""

import logging
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from spiked.errors import SourceError
from spiked.ring import DeviceState, DeviceStatus, End, Gap
from spiked.sensor import Sensor
from spiked_driver.framing import USB_HEIGHT, USB_WIDTH, FramingCounters, UsbFraming
from spiked_driver.gap_attribution import GapAttribution
from spiked_driver.opening import OpeningFilter
from spiked_driver.source import READ_WAIT_S, Chunk, former_source_names
from spiked_driver.usb_budget import TransferPlan, plan_transfers, usbfs_limit
from spiked_driver.usb_cameras import CameraChoice, UsbCamera
from spiked_driver.usb_connection import UsbConnection, UsbOptions

_log = logging.getLogger(__name__)


@former_source_names
class UsbSource:
    """A 400x250 camera behind an FT601: bytes of a `UsbConnection`, framed, with gaps attributed to their cause.

    An absent, lost or returning camera is a device status and a gap, not an error.
    """

    def __init__(
        self, choice: CameraChoice, options: UsbOptions | None = None, warn: Callable[[str], None] | None = None
    ) -> None:
        """`warn` gets one sentence for each fault that the capture survives."""
        self.choice = choice
        self.options = options or UsbOptions()
        self._forward_warning = warn
        camera = self.options.camera.model_copy(update={"rate": self.options.rate_hz})
        self._sensor = camera.sensor(Sensor(USB_WIDTH, USB_HEIGHT, self.options.rate_hz))
        self._connection: UsbConnection | None = None
        self._seen_ns = 0
        self._start_stream()

    @property
    def sensor(self) -> Sensor:
        """400x250, rows in the camera's order."""
        return self._sensor

    @property
    def frames(self) -> int | None:
        """None: a camera has no end."""
        return None

    @property
    def can_block(self) -> bool:
        """False: a camera does not wait."""
        return False

    @property
    def device_status(self) -> DeviceStatus:
        """Absent without a camera, armed once its reads are queued, streaming with its frames, lost after an error."""
        return self._connection.device_status if self._connection else DeviceStatus(DeviceState.IDLE)

    @property
    def camera(self) -> UsbCamera | None:
        """The camera in use, or the last one that was."""
        return self._connection.camera if self._connection else None

    @property
    def plan(self) -> TransferPlan:
        """The reads to queue. Raises SourceError if they need more memory than the kernel allows."""
        return plan_transfers(
            self.options.rate_bytes,
            usbfs_limit(),
            buffer_s=self.options.buffer_s,
            transfer_bytes=self.options.transfer_bytes,
        )

    @property
    def counters(self) -> FramingCounters:
        """Counters of the framing since `open`."""
        return self._framing.counters

    def open(self) -> None:
        """Search for the camera and queue its reads; an absent camera is no error.

        Raises SourceError if the camera is there and cannot be used, or if the kernel does not allow the reads.
        """
        self.close()
        self._start_stream()
        self._connection = UsbConnection(self.choice, self.options, self.plan, self._warn)
        self._connection.open()

    def close(self) -> None:
        """End all transfers and close the camera, within 0.4 s."""
        if self._connection is not None:
            self._framing.keep()
            self._connection.close()

    def read_into(self, view: NDArray[np.uint8]) -> Chunk | Gap | End | None:
        """See `Source.read_into`."""
        if self._connection is None:
            raise SourceError(f"the camera {self.choice} is not open: open it before reading")
        while (item := self._frames.read_into(view)) is None:
            if not self._receive(self._connection):
                return None
        if isinstance(item, Gap):
            return self._gaps.attributed(item)
        self._connection.frame_delivered()
        return replace(item, seen_ns=self._seen_ns)

    def _receive(self, connection: UsbConnection) -> bool:
        """Feed the next bytes to the framing; false when the caller should get control back."""
        self._framing.keep()
        reception = connection.receive(self._framing.counters.received)
        if reception.underrun_bytes is not None:
            self._gaps.underrun(reception.underrun_bytes)
        if not reception.data.size:
            return False
        if not reception.contiguous:
            self._framing.mark_loss()
        self._gaps.received(reception.data.size, time.monotonic(), reception.ended_break)
        self._seen_ns = reception.seen_ns
        self._framing.feed(reception.data)
        return connection.frameless_s < READ_WAIT_S

    def _start_stream(self) -> None:
        self._framing = UsbFraming()
        self._frames = OpeningFilter(self._framing, self.options.rate_hz, self._warn_of_old_frames)
        self._gaps = GapAttribution(self._framing, self.options.rate_hz)

    def _warn_of_old_frames(self, count: int, age_frames: int) -> None:
        frames = "1 old frame" if count == 1 else f"{count} old frames"
        self._warn(
            f"{frames} lay in the camera when the capture began, {age_frames:,} frames before its first: discarded"
        )

    def _warn(self, warning: str) -> None:
        _log.warning("%s", warning)
        if self._forward_warning is not None:
            self._forward_warning(warning)
