"""The raw stream of the PCIe camera (`Flavour.E`): parsing, and a source that reads a file, a pipe or a device node."""

import os
import select
import stat
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from spiked.native._wire import PcieParser

from spiked.camera import CameraOptions
from spiked.errors import SourceError
from spiked.ring import DeviceState, DeviceStatus, End, EndReason, Gap
from spiked.sensor import Sensor
from spiked_driver.capabilities import PCIE_CAPABILITIES
from spiked_driver.framing import Framing, FramingBenchmark, benchmark_framing
from spiked_driver.source import READ_WAIT_S, Chunk, former_source_names
from spiked_driver.source_kind import RATE_HZ, Device, HardwareOptions, SourceKind, SourceSpec, Warn, path_of

PCIE_SIZE = 1000
"""Pixels in a row, and rows."""
PCIE_FRAME_BYTES = 128_000
"""A frame in the stream: 2000 half-lines of 64 bytes."""
PCIE_COMPACT_BYTES = 125_000
"""A frame's pixels: 1000 rows of 125 bytes."""
BLOCK_BYTES = 1 << 20
"""Bytes per read; the capture card returns multiples of 64 bytes."""


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
    """A camera read from a path: the capture card's device node, a pipe, or a file of the raw stream."""

    def __init__(self, path: str | os.PathLike[str], camera: CameraOptions | None = None) -> None:
        """`camera`: what the stream does not say of its camera."""
        self.path = Path(path)
        self._sensor = (camera or CameraOptions()).sensor(Sensor(PCIE_SIZE, PCIE_SIZE, RATE_HZ))
        self._framing = PcieFraming()
        self._block = bytearray(BLOCK_BYTES)
        self._file: int | None = None
        self._is_file = False
        self._ended = False
        self._device_status = DeviceStatus(DeviceState.IDLE)

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
        """Armed once open, streaming from the first frame, idle after the end."""
        return self._device_status

    def open(self) -> None:
        """Open the path for reading. Raises SourceError."""
        self.close()
        try:
            self._file = os.open(self.path, os.O_RDONLY | os.O_NONBLOCK)
        except OSError as error:
            raise SourceError(
                f"{self.path}: cannot be read: {error.strerror}; check the path and its permissions"
            ) from error
        self._is_file = stat.S_ISREG(os.fstat(self._file).st_mode)
        self._framing = PcieFraming()
        self._ended = False
        self._device_status = DeviceStatus(DeviceState.ARMED)

    def close(self) -> None:
        """Close the path."""
        if self._file is not None:
            os.close(self._file)
            self._file = None
        self._device_status = DeviceStatus(DeviceState.IDLE)

    def read_into(self, view: NDArray[np.uint8]) -> Chunk | Gap | End | None:
        """See `Source.read_into`."""
        while (item := self._framing.read_into(view)) is None:
            if self._ended:
                self._device_status = DeviceStatus(DeviceState.IDLE, "the stream has ended")
                return End(self._framing.next_index, EndReason.FINISHED)
            if not self._read_block():
                return None
        self._device_status = DeviceStatus(DeviceState.STREAMING)
        return item

    def _read_block(self) -> bool:
        """Read once; false if no byte came within READ_WAIT_S."""
        if self._file is None:
            raise SourceError(f"{self.path}: the source is not open: open it before reading")
        if not select.select([self._file], [], [], READ_WAIT_S)[0]:
            return False
        self._framing.keep()
        try:
            count = os.readv(self._file, [self._block])
        except BlockingIOError:
            return False
        except OSError as error:
            raise SourceError(
                f"{self.path}: reading failed: {error.strerror}; check the card and its driver"
            ) from error
        if count:
            self._framing.feed(memoryview(self._block)[:count])
        else:
            self._framing.finish()
            self._ended = True
        return True


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
    return PcieSource(path_of(spec, f"{KIND.usage}, a device node, a pipe or a file"), options)


def _describe(spec: SourceSpec) -> Device:
    return Device(spec.text, KIND.name, "raw stream of a PCIe camera", capabilities=PCIE_CAPABILITIES)


KIND = SourceKind(
    name="pcie",
    usage="pcie:PATH",
    summary="the raw stream of a PCIe spike camera, from a device node, a pipe or a file",
    options=HardwareOptions,
    open=_open,
    describe=_describe,
    is_camera=True,
    takes_path=True,
)
