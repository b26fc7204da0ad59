"""Converts bytes of the USB3 camera (`Flavour.C`) to compact frames and gaps, and back."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from spiked.native._wire import Counters, Event, Kind, UsbParser

from spiked.errors import SourceError
from spiked.ring import Gap, LossCause
from spiked_driver.source import Chunk

USB_WIDTH, USB_HEIGHT = 400, 250
"""Pixels in a row, and rows."""
USB_FRAME_BYTES = 13_016
"""A frame on the wire: 16 bytes of header and 250 rows of 52 bytes."""
USB_COMPACT_BYTES = 12_500
"""A frame's pixels: 250 rows of 50 bytes."""
_MAGIC, _WORD1 = 0x63606300, 0x00100021
"""First two words of a header."""


@dataclass(frozen=True)
class FramingCounters:
    """Counters of a parser since its creation."""

    bytes: int
    received: int
    """Frames delivered."""
    lost: int
    """Frames reported in gaps."""
    duplicates: int
    """Frames that came again or late and were dropped."""
    skipped_bytes: int
    """Bytes outside delivered and duplicated frames: junk and damaged frames."""
    resyncs: int
    """Times that synchronisation was lost."""
    restarts: int
    """Times that the camera's counters started anew."""

    def position(self, frame_bytes: int) -> int:
        """Bytes of the stream that are parsed, for frames of `frame_bytes` bytes on the wire."""
        return (self.received + self.duplicates) * frame_bytes + self.skipped_bytes


class Parser(Protocol):
    """Interface of the native parsers of both wire formats."""

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
    """Parses bytes in chunks of any size into frames and gaps. Used by one thread.

    Index 0 is the first frame found. Every index below `next_index` was delivered once or was in one gap.
    """

    def __init__(self, parser: Parser) -> None:
        self._parser = parser

    @property
    def next_index(self) -> int:
        """Received and lost frames so far."""
        return int(self._parser.next_index)

    @property
    def counters(self) -> FramingCounters:
        """Counters since the start."""
        c = self._parser.counters
        return FramingCounters(c.bytes, c.received, c.lost, c.duplicates, c.skipped, c.resyncs, c.restarts)

    def feed(self, chunk: bytes | bytearray | memoryview | NDArray[np.uint8]) -> None:
        """Parse the next bytes. They are read in place and must not change until the next `feed` or `keep`."""
        self._parser.feed(np.frombuffer(chunk, np.uint8))

    def keep(self) -> None:
        """Copy the unread rest of the chunk, so that its memory may be reused."""
        self._parser.keep()

    def mark_loss(self) -> None:
        """State that the host lost bytes before the next chunk: frames missing there have the cause `usb`."""
        self._parser.mark_loss()

    def finish(self) -> None:
        """State that no more bytes follow; `read_into` then returns a last frame that awaited the next header."""
        self._parser.finish()

    def read_into(self, view: NDArray[np.uint8]) -> Chunk | Gap | None:
        """Write the next frames into `view`, uint8 [n, frame_bytes], compact, rows in the camera's order.

        None when more bytes are needed.
        """
        return event_item(self._parser.next(view))


class UsbFraming(Framing):
    """The parser of the SPS10's stream from endpoint 0x82.

    A frame is delivered if its header has the session's constants, its two counters agree and all row numbers are
    right; pixels are not checked. The first frame must also be confirmed by the next header. A gap has the cause
    `device` if the counters jump between two frames without a damaged byte between them, else `usb`.
    """

    def __init__(self) -> None:
        self._usb = UsbParser()
        super().__init__(self._usb)

    def resume(self, lost: int, tolerance: int, cause: LossCause) -> None:
        """The stream was interrupted and the camera may count anew: drop partial frames; a gap of `cause` follows.

        `lost` frames are missing by the host's clock. The camera's count is used instead if it continues and differs by
        at most `tolerance` frames. If called again before the next frame, the later call is used.
        """
        self._usb.resume(lost, tolerance, Kind.DEVICE_GAP if cause is LossCause.DEVICE else Kind.HOST_GAP)


def event_item(event: Event) -> Chunk | Gap | None:
    """Converts an event of a native parser to an item of a `Source`."""
    if event.kind == Kind.NONE:
        return None
    if event.kind == Kind.FRAMES:
        return Chunk(event.first, event.count)
    return Gap(event.first, event.count, LossCause.DEVICE if event.kind == Kind.DEVICE_GAP else LossCause.USB)


def encode_usb(frames: NDArray[np.uint8], *, first: int = 0, lines: int = 0, nbytes: int = 0) -> NDArray[np.uint8]:
    """Wire bytes, uint8 [n, 13016], of compact frames, uint8 [n, 12500], with indices from `first` on.

    `lines` and `nbytes` are the values of the camera's two counters at index 0, modulo 2^32.
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
    """Throughput of a parser in wire bytes, and of copying the same bytes, on one core."""

    parsed_bytes_a_second: float
    memcpy_bytes_a_second: float

    @property
    def ratio(self) -> float:
        """Parser divided by memcpy."""
        return self.parsed_bytes_a_second / self.memcpy_bytes_a_second


def benchmark_usb(frames: int = 1500, repeat: int = 3) -> FramingBenchmark:
    """Best of `repeat` passes over `frames` random frames in chunks of 256 KiB."""
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
