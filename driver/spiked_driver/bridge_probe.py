"""Finds out which way of reading a camera's bridge brings frames: each is tried on the camera itself."""

import platform
import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import count

import numpy as np
import usb.core

from spiked.errors import SourceError
from spiked_driver.framing import USB_COMPACT_BYTES, USB_FRAME_BYTES, UsbFraming
from spiked_driver.ft60x import SessionMode
from spiked_driver.libusb import OutOfUsbMemoryError
from spiked_driver.source_kind import RATE_HZ
from spiked_driver.transfers import Buffers, CompletedTransfer, transfer_error_of
from spiked_driver.usb_budget import TransferPlan
from spiked_driver.usb_cameras import CameraChoice, UsbCamera, find_cameras
from spiked_driver.usb_session import NotThereError, UsbSession

PROBE_S = 2.0
"""How long each way is read."""
PLAN = TransferPlan(count=16, transfer_bytes=1 << 18, rate_bytes=USB_FRAME_BYTES * RATE_HZ)
"""16 reads of 256 KiB, as the vendor's software has: they fit the kernel's default limit."""
BACK_S = 1.0
"""Longest wait for a camera that was reset."""
FIRST_BYTES = 32
"""Bytes of the stream that are reported."""
STOPPED_S = 0.5
"""A way that brought nothing in the last so many seconds has stopped: the camera sends all the time."""
STOP_S = 0.4
"""Longest wait for cancelled reads."""
_WAIT_S = 0.05
"""Longest wait for one read."""


@dataclass(frozen=True)
class Way:
    """A way of reading."""

    name: str
    options: str
    """For the text of a source, `usb0?OPTIONS`."""
    mode: SessionMode
    asynchronous: bool


WAYS = (
    Way("queued read requests", "session=request", SessionMode.REQUEST, True),
    Way("stream mode", "session=stream", SessionMode.STREAM, True),
    Way("single read requests", "session=request&transfers=single", SessionMode.REQUEST, False),
)
"""In the order in which they are tried: the default first."""


@dataclass(frozen=True)
class WayResult:
    """What one way brought."""

    name: str
    options: str
    seconds: float
    """From the first read to the end."""
    bytes: int
    frames: int
    lost: int
    """Frames missing by the camera's count."""
    first_bytes: str
    """Hexadecimal, of the first bytes that came."""
    last_byte_s: float
    """When the last byte came."""
    error: str | None
    """Why it ended early."""

    @property
    def verdict(self) -> str:
        """`frames`, `stopped` if no more came in the end, `bytes` without a frame, or `nothing`."""
        if not self.frames:
            return "bytes" if self.bytes else "nothing"
        return "stopped" if self.error or self.seconds - self.last_byte_s > STOPPED_S else "frames"


@dataclass(frozen=True)
class BridgeReport:
    """What came of all ways."""

    camera: UsbCamera
    bridge: str | None
    """The chip's configuration; None if it does not tell."""
    host: str
    """System and kernel."""
    ways: tuple[WayResult, ...]

    @property
    def works(self) -> WayResult | None:
        """The first way that brought frames to the end."""
        return next((way for way in self.ways if way.verdict == "frames"), None)


def probe(
    choice: CameraChoice, tell: Callable[[str], None] = lambda name: None, seconds: float = PROBE_S
) -> BridgeReport:
    """Read a camera in each way for some seconds; `tell` gets the name of each before it is tried.

    Raises SourceError for a camera that is not there, may not be opened, or is in use.
    """
    camera = choice.pick(find_cameras())
    if camera is None:
        raise SourceError(f"there is no camera {choice}: plug it in, and see `spiked devices`")
    buffers, results, chip = Buffers(PLAN), [], None
    for way in WAYS:
        tell(way.name)
        session = _opened(choice, buffers, way)
        chip = chip or session.chip
        try:
            results.append(_read(session, way, seconds))
            if session.reader.stop(STOP_S) and not results[-1].bytes:
                session.reset()  # what this way did must not spoil the next
        finally:
            session.close(STOP_S)
    return BridgeReport(camera, None if chip is None else str(chip), platform.platform(), tuple(results))


def _opened(choice: CameraChoice, buffers: Buffers, way: Way) -> UsbSession:
    """The camera, open; waits for one that was reset."""
    until_s = time.monotonic() + BACK_S
    for attempt in count():
        try:
            camera = choice.pick(find_cameras())
            if camera is None:
                raise NotThereError(f"the camera {choice} did not come back after a reset: plug it in again")
            return UsbSession(camera, buffers, mode=way.mode, asynchronous=way.asynchronous)
        except NotThereError:
            if time.monotonic() > until_s:
                raise
            time.sleep(_WAIT_S * (1 + attempt))
    raise AssertionError("the loop has no end")


def _read(session: UsbSession, way: Way, seconds: float) -> WayResult:
    framing, frames = UsbFraming(), np.empty((64, USB_COMPACT_BYTES), np.uint8)
    first, last_s, error = b"", 0.0, None
    begun_s = time.monotonic()
    try:
        session.start()
        while error is None and time.monotonic() - begun_s < seconds:
            session.reader.release()
            transfer = session.reader.next(_WAIT_S)
            if transfer is not None:
                first = first or transfer.data[:FIRST_BYTES].tobytes()
                last_s = time.monotonic() - begun_s if transfer.data.size else last_s
                error = _take(transfer, framing, frames)
    except usb.core.USBError as raised:
        error = str(transfer_error_of(raised))
    except OutOfUsbMemoryError as raised:
        error = str(raised)
    seconds_read = time.monotonic() - begun_s
    counted = framing.counters
    return WayResult(
        way.name,
        way.options,
        seconds_read,
        counted.bytes,
        counted.received,
        counted.lost,
        first.hex(" "),
        last_s,
        error,
    )


def _take(transfer: CompletedTransfer, framing: UsbFraming, frames: np.ndarray) -> str | None:
    """Count the frames of a transfer; why it is the last one, None if it is not."""
    framing.feed(transfer.data)
    while framing.read_into(frames) is not None:
        continue
    framing.keep()
    return None if transfer.error is None else str(transfer.error)
