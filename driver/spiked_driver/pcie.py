"""The raw stream of the PCIe camera (`Flavour.E`): parsing, and a source that reads a file, a pipe or a device node."""

import os
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from spiked.native._wire import PcieParser

from spiked.camera import CameraOptions
from spiked.recording.geometry import Assumable
from spiked.ring import DeviceState, DeviceStatus, End, EndReason, Gap, LossCause
from spiked.sensor import Sensor
from spiked_driver.capabilities import PCIE_CAPABILITIES
from spiked_driver.card_file import CardFile, absence
from spiked_driver.framing import Framing, FramingBenchmark, benchmark_framing
from spiked_driver.source import Chunk, former_source_names
from spiked_driver.source_kind import RATE_HZ, Device, HardwareOptions, SourceKind, SourceSpec, Warn, path_of

PCIE_SIZE = 1000
"""Pixels in a row, and rows."""
PCIE_FRAME_BYTES = 128_000
"""A frame in the stream: 2000 half-lines of 64 bytes."""
PCIE_COMPACT_BYTES = 125_000
"""A frame's pixels: 1000 rows of 125 bytes."""
BLOCK_BYTES = 1 << 20
"""Bytes per read; the capture card returns multiples of 64 bytes."""
CARDS = (Path("/dev/JR6101"),)
"""Device nodes of the known capture card."""


class PcieFraming(Framing):
    """The parser of the M1K40's raw stream.

    A frame is delivered if all its 2000 half-lines have the right line and channel. Their order is taken from the first
    two frames that agree. The stream has no frame counter: a gap is one frame for every 128,000 skipped bytes, at least
    one. Whole frames missing without a trace are not detected.
    """

    def __init__(self) -> None:
        super().__init__(PcieParser())


@former_source_names
class PcieSource:
    """A camera read from a path: the capture card's device node, a pipe, or a file of the raw stream.

    A card that is absent, fails a read or comes back is a device status and a gap, not an error. The stream has no
    frame counter: the frames of an interruption are counted by the clock. A file or pipe ends the capture with its last
    byte.
    """

    def __init__(
        self, path: str | os.PathLike[str], camera: CameraOptions | None = None, warn: Warn | None = None
    ) -> None:
        """`camera`: what the stream does not say of its camera. `warn` gets one sentence for each interruption."""
        self.path = Path(path)
        self._sensor = (camera or CameraOptions()).sensor(Sensor(PCIE_SIZE, PCIE_SIZE, RATE_HZ))
        self._warn = warn
        self._is_file = self.path.is_file()
        self._card = CardFile(self.path)
        self._framing = PcieFraming()
        self._block = bytearray(BLOCK_BYTES)
        self._zero = 0  # index in the capture of the framing's frame 0
        self._read_s = 0.0  # monotonic time of the last bytes
        self._break: LossCause | None = None
        self._ended = False

    @property
    def sensor(self) -> Sensor:
        """1000x1000, rows in the camera's order."""
        return self._sensor

    @property
    def frames(self) -> int | None:
        """None: the length is unknown."""
        return None

    @property
    def can_block(self) -> bool:
        """True for a file: it can be read late without a loss."""
        return self._is_file

    @property
    def device_status(self) -> DeviceStatus:
        """Absent without a card, armed once open, streaming from the first frame, lost after an error or in silence."""
        return self._card.status

    def open(self) -> None:
        """Open the path for reading; an absent card is no error. Raises SourceError for one that may not be read."""
        self.close()
        self._card = CardFile(self.path)
        self._framing = PcieFraming()
        self._zero, self._break, self._ended = 0, None, False
        self._card.open()

    def close(self) -> None:
        """Close the path."""
        self._card.close()

    def read_into(self, view: NDArray[np.uint8]) -> Chunk | Gap | End | None:
        """See `Source.read_into`."""
        while (item := self._framing.read_into(view)) is None:
            if self._ended:
                self._card.status = DeviceStatus(DeviceState.IDLE, "the stream has ended")
                return End(self._zero + self._framing.next_index, EndReason.FINISHED)
            received = self._receive()
            if received is None or isinstance(received, Gap):
                return received
        if self._card.is_open:
            self._card.status = DeviceStatus(DeviceState.STREAMING)
        if isinstance(item, Gap):
            return replace(item, first=self._zero + item.first)
        return Chunk(self._zero + item.first, item.frames, round(1e9 * self._read_s))

    def _receive(self) -> int | Gap | None:
        """Feed the next bytes to the framing, and return their number; None if nothing came within READ_WAIT_S.

        The first bytes after an interruption return the gap before them.
        """
        if not self._card.is_open:
            if self._break is not None:  # all that came before it is delivered
                self._zero += self._framing.next_index
                self._framing = PcieFraming()
            self._card.reopen()
            return None
        self._framing.keep()
        try:
            count = self._card.read_into(self._block)
        except OSError as error:
            self._interrupted(error)
            return None
        if count is None:
            return None
        gap = self._gap_before(count)
        self._read_s = time.monotonic()
        if count:
            self._framing.feed(memoryview(self._block)[:count])
        else:
            self._framing.finish()
            self._ended = True
        return count if gap is None else gap

    def _interrupted(self, error: OSError) -> None:
        """Deliver what came before the error, then look for the card again."""
        self._break = self._card.lose(error)
        self._framing.finish()
        if self._warn is not None:
            self._warn(f"{self._card.status.reason}: frames until it is read again are lost")

    def _gap_before(self, count: int) -> Gap | None:
        """The frames that an interruption has cost, before the first `count` bytes after it."""
        if self._break is None:
            return None
        cause = LossCause.DEVICE if self._card.was_absent else self._break
        self._break = None
        if not self._zero:
            return None
        missing_s = time.monotonic() - self._read_s
        lost = max(1, round(missing_s * self._sensor.frame_rate_hz - count / PCIE_FRAME_BYTES))
        self._zero += lost
        return Gap(self._zero - lost, lost, cause)


def encode_pcie(frames: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The raw stream, uint8 [n, 128000], of compact frames, uint8 [n, 125000].

    The order of lines and channels within a frame is not published. It is inferred from a frame's first and last line:
    rows 0 to 499 are lines 500 to 1 of channels 0 and 1, rows 500 to 999 lines 1 to 500 of channels 2 and 3.
    """
    count = len(frames)
    pixels = frames.reshape(count, PCIE_SIZE, 125)
    halves = np.zeros((count, PCIE_SIZE, 2, 64), np.uint8)
    halves[:, :, 0, :63] = pixels[:, :, :63]
    halves[:, :, 0, 62] &= 0x0F
    second = pixels[:, :, 62:]
    halves[:, :, 1, :63] = second >> 4
    halves[:, :, 1, :62] |= second[:, :, 1:] << 4
    tags = _tags() << 4
    halves[..., 62] |= (tags & 0xFF).astype(np.uint8)
    halves[..., 63] = tags >> 8
    return halves.reshape(count, PCIE_FRAME_BYTES)


def _tags() -> NDArray[np.uint16]:
    """Line and channel (bits 10-11) of every half-line, uint16 [1000, 2]."""
    row = np.arange(PCIE_SIZE)
    upper = row < 500
    line = np.where(upper, 500 - row, row - 499)
    channel = np.where(upper, 0, 2)[:, None] + np.arange(2)
    return np.asarray(line[:, None] | channel << 10, np.uint16)


def benchmark_pcie(frames: int = 150, repeat: int = 3) -> FramingBenchmark:
    """Best of `repeat` passes over `frames` random frames in blocks of 1 MiB."""
    pixels = np.random.default_rng(0).integers(0, 256, (frames, PCIE_COMPACT_BYTES), np.uint8)
    return benchmark_framing(PcieFraming, encode_pcie(pixels), PCIE_COMPACT_BYTES, BLOCK_BYTES, repeat)


def _open(spec: SourceSpec, options: HardwareOptions, warn: Warn | None) -> PcieSource:
    return PcieSource(path_of(spec, f"{KIND.usage}, a device node, a pipe or a file"), options, warn)


def _describe(spec: SourceSpec) -> Device:
    device = Device(spec.text, KIND.name, "raw stream of a PCIe camera", capabilities=PCIE_CAPABILITIES)
    path = Path(spec.target or "")
    return device if path.exists() else replace(device, state=DeviceState.ABSENT, reason=absence(path))


def _find() -> list[Device]:
    return [_describe(SourceSpec.parse(f"{KIND.name}:{path}")) for path in CARDS if path.exists()]


def _assumed(source: PcieSource, options: HardwareOptions) -> tuple[Assumable, ...]:
    """Public recordings of this camera come either way up."""
    return ("flipped",) if options.flipped is None else ()


KIND = SourceKind(
    name="pcie",
    usage="pcie:PATH",
    summary="the raw stream of a PCIe spike camera, from a device node, a pipe or a file",
    options=HardwareOptions,
    open=_open,
    describe=_describe,
    assumed=_assumed,
    find=_find,
    is_camera=True,
    takes_path=True,
)
