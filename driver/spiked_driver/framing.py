"""The bytes of the USB3 camera (flavour C) to compact frames and gaps, and back."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from spiked.native._wire import Counters, Event, Kind, UsbParser

from spiked.errors import SourceError
from spiked.ring import Cause, Gap
from spiked_driver.source import Chunk

USB_WIDTH, USB_HEIGHT = 400, 250
USB_FRAME_BYTES = 13_016
"""A frame on the wire: 16 bytes of header and 250 rows of 52 bytes."""
USB_COMPACT_BYTES = 12_500
_MAGIC, _WORD1 = 0x63606300, 0x00100021


@dataclass(frozen=True)
class FramingCounters:
    """What a parser made of the bytes so far."""

    bytes: int
    received: int
    """Frames delivered."""
    lost: int
    """Frames told of in gaps."""
    duplicates: int
    """Frames that came a second time or late, and were dropped."""
    skipped_bytes: int
    """Bytes of no delivered or duplicated frame: junk, and what damage spoilt."""
    resyncs: int
    """Times that frames no longer followed one another."""
    restarts: int
    """Times that the camera's counters began anew."""

    def position(self, frame_bytes: int) -> int:
        """Up to which byte of the stream it has been understood, if a frame has that many."""
        return (self.received + self.duplicates) * frame_bytes + self.skipped_bytes


class Parser(Protocol):
    """The native face that both wire formats share."""

    def feed(self, chunk: NDArray[np.uint8]) -> None: ...
    def keep(self) -> None: ...
    def finish(self) -> None: ...
    def mark_loss(self) -> None: ...
    def next(self, out: NDArray[np.uint8]) -> Event: ...
    @property
    def next_index(self) -> int: ...
    @property
    def counters(self) -> Counters: ...


class Framing:
    """Bytes in, in chunks of any size; frames and gaps out. Used by one thread.

    Index 0 is the first frame found; every index below `next_index` was delivered once or was in one gap.
    """

    def __init__(self, parser: Parser) -> None:
        self._parser = parser

    @property
    def next_index(self) -> int:
        """Received and lost frames so far."""
        return int(self._parser.next_index)

    @property
    def counters(self) -> FramingCounters:
        """What was made of the bytes so far."""
        c = self._parser.counters
        return FramingCounters(c.bytes, c.received, c.lost, c.duplicates, c.skipped, c.resyncs, c.restarts)

    def feed(self, chunk: bytes | bytearray | memoryview | NDArray[np.uint8]) -> None:
        """Give the next bytes. They are read in place: leave them as they are until the next `feed` or `keep`."""
        self._parser.feed(np.frombuffer(chunk, np.uint8))

    def keep(self) -> None:
        """Copy what is left of the chunk, so that its memory may be used again."""
        self._parser.keep()

    def mark_loss(self) -> None:
        """Say that bytes were lost before the next chunk: what is missing then is the host's loss, not the camera's."""
        self._parser.mark_loss()

    def finish(self) -> None:
        """Say that no more bytes come; `read_into` then gives what waited for its successor."""
        self._parser.finish()

    def read_into(self, view: NDArray[np.uint8]) -> Chunk | Gap | None:
        """Write the next frames into `view`, uint8 [n, frame_bytes], compact, rows in the camera's order.

        None when more bytes are needed.
        """
        return event_item(self._parser.next(view))


class UsbFraming(Framing):
    """The parser of the SPS10's stream from endpoint 0x82.

    A frame is delivered when its header has the session's constants, its counters agree with each other and all its row
    numbers are right; pixels have no check. The first one also needs the next header to confirm it. A gap is the
    device's when the counters jump between frames that follow one another without a byte amiss, else the host's.
    """

    def __init__(self) -> None:
        self._usb = UsbParser()
        super().__init__(self._usb)

    def resume(self, lost: int, tolerance: int, cause: Cause) -> None:
        """The stream broke off, and the camera may count anew: half frames are dropped, a gap follows with that cause.

        By the host's clock `lost` frames are missing; the camera's own count is taken instead if it runs on and differs
        by at most `tolerance`. Called again before a frame came, the later call counts.
        """
        self._usb.resume(lost, tolerance, Kind.DEVICE_GAP if cause is Cause.DEVICE else Kind.HOST_GAP)


def event_item(event: Event) -> Chunk | Gap | None:
    """What a native parser found, in the words of a `Source`."""
    if event.kind == Kind.NONE:
        return None
    if event.kind == Kind.FRAMES:
        return Chunk(event.first, event.count)
    return Gap(event.first, event.count, Cause.DEVICE if event.kind == Kind.DEVICE_GAP else Cause.USB)


def encode_usb(frames: NDArray[np.uint8], *, first: int = 0, lines: int = 0, nbytes: int = 0) -> NDArray[np.uint8]:
    """The wire bytes, uint8 [n, 13016], of compact frames, uint8 [n, 12500], with indices from `first` on.

    `lines` and `nbytes` are what the camera's two counters, modulo 2^32, show at index 0.
    """
    count = len(frames)
    wire = np.empty((count, USB_FRAME_BYTES), np.uint8)
    index = np.arange(first, first + count, dtype=np.uint64)
    header = np.empty((count, 4), "<u4")
    header[:, 0], header[:, 1] = _MAGIC, _WORD1
    header[:, 2] = (nbytes + USB_COMPACT_BYTES * index) & 0xFFFFFFFF
    header[:, 3] = (lines + USB_HEIGHT * index) & 0xFFFFFFFF
    wire[:, :16] = header.view(np.uint8)
    rows = wire[:, 16:].reshape(count, USB_HEIGHT, 52)
    rows[:, :, :50] = frames.reshape(count, USB_HEIGHT, 50)
    rows[:, :, 50:] = np.arange(USB_HEIGHT, dtype="<u2").view(np.uint8).reshape(USB_HEIGHT, 2)
    return wire


@dataclass(frozen=True)
class FramingBenchmark:
    """Throughput of a parser in wire bytes, next to plain copying of the same bytes, on one core."""

    parsed_bytes_a_second: float
    memcpy_bytes_a_second: float

    @property
    def ratio(self) -> float:
        """Parser to memcpy."""
        return self.parsed_bytes_a_second / self.memcpy_bytes_a_second


def benchmark_usb(frames: int = 1500, repeat: int = 3) -> FramingBenchmark:
    """Best of `repeat` passes over so many random frames in reads of 256 KiB, as the camera is read."""
    pixels = np.random.default_rng(0).integers(0, 256, (frames, USB_COMPACT_BYTES), np.uint8)
    return benchmark_framing(UsbFraming, encode_usb(pixels), USB_COMPACT_BYTES, 256 << 10, repeat)


def benchmark_framing(
    make: Callable[[], Framing], wire: NDArray[np.uint8], compact_bytes: int, chunk_bytes: int, repeat: int
) -> FramingBenchmark:
    """Best of `repeat` passes over wire bytes, uint8 [frames, bytes a frame], all different, in chunks."""
    data = wire.reshape(-1)
    out = np.zeros((len(wire), compact_bytes), np.uint8)
    copy = np.zeros_like(data)
    parsed_s, copied_s = [], []
    for _ in range(repeat):
        start_s = time.perf_counter()
        np.copyto(copy, data)
        copied_s.append(time.perf_counter() - start_s)
        framing = make()
        start_s = time.perf_counter()
        for start in range(0, data.size, chunk_bytes):
            framing.feed(data[start : start + chunk_bytes])
            while framing.read_into(out[framing.next_index :]):
                pass
        framing.finish()
        framing.read_into(out[framing.next_index :])
        parsed_s.append(time.perf_counter() - start_s)
        if framing.counters.received != len(wire):
            raise SourceError(f"the parser found {framing.counters.received} of {len(wire)} undamaged frames")
    return FramingBenchmark(data.nbytes / min(parsed_s), data.nbytes / min(copied_s))
