"""Spikes in other containers: arrays of NumPy and HDF5, photon cubes, and frames whose rows do not end with a byte.

Photon cubes are `.npy` files, uint8 [t, h, w / 8], the leftmost pixel in the highest bit (PyPI package `photoncube`).
Vidar files of widths that are no multiple of 8 have the bits of a frame one after the other (`load_vidar_dat` of
SpikeCV and Spike-Zoo).
"""

import math
import zipfile
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spiked.camera import MOST_SIDE
from spiked.errors import RecordingError
from spiked.numpy_files import UNREADABLE, array_header
from spiked.sensor import BitOrder

__all__ = ["SpikeArray", "is_array", "open_array", "open_bits"]

NUMPY_MAGIC, ZIP_MAGIC, HDF5_MAGIC = b"\x93NUMPY", b"PK\x03\x04", b"\x89HDF\r\n\x1a\n"
"""First bytes of `.npy`, of `.npz`, and of HDF5."""
LOOKED_AT = 64
"""Frames by which packed arrays are told from arrays of 0 and 1."""
BLOCK_FRAMES = 64
"""Frames that are converted at a time, at most."""
BLOCK_BYTES = 16 << 20
"""Bytes of the container that are converted at a time, at most, but a frame."""
MOST_ARRAYS = 1000
"""Arrays in an `.npz` file, at most."""
MOST_CHUNK_BYTES = 1 << 30
"""Of an HDF5 file, which unpacks a chunk as a whole."""


@dataclass(frozen=True)
class SpikeArray:
    """Frames of 0 and 1 in some container."""

    path: Path
    stored: Any
    """Sliced along its first axis, as a NumPy array: [t, h, w] of 0 and 1, or bytes [t, ...]."""
    frames: int
    height: int
    columns: int
    """Columns of the container."""
    packed: BitOrder | None
    """Order of the bits where eight pixels are in a byte; None: an element a pixel."""
    trailing_bytes: int = 0
    """Bytes after the last whole frame."""

    @property
    def width(self) -> int:
        """Columns that a recording can have: a multiple of 8. Those beyond at the right are left out."""
        return self.columns // 8 * 8

    def blocks(self) -> Iterator[NDArray[np.uint8]]:
        """Compact frames, uint8 [n, height * width / 8], LSB first.

        Raises RecordingError for other values than 0 and 1.
        """
        count = _block_frames(self.stored)
        for first in range(0, self.frames, count):
            pixels = self._pixels(first, min(first + count, self.frames))
            compact = np.packbits(pixels[:, :, : self.width], axis=2, bitorder="little")
            yield compact.reshape(len(compact), -1)

    def _pixels(self, begin: int, end: int) -> NDArray[np.uint8]:
        """uint8 [n, height, columns] of 0 and 1."""
        try:
            block = np.asarray(self.stored[begin:end])
        except UNREADABLE as error:
            message = f"{self.path}: frames {begin} to {end - 1} cannot be read, the file is damaged: {error}"
            raise RecordingError(message) from error
        if self.packed is not None:
            order: Any = "little" if self.packed is BitOrder.LSB else "big"
            bits = np.unpackbits(block.reshape(len(block), -1), axis=1, bitorder=order)
            row = bits.shape[1] // self.height if block.ndim == 3 else self.columns
            return bits[:, : self.height * row].reshape(len(block), self.height, row)[:, :, : self.columns]
        if not ((block == 0) | (block == 1)).all():
            is_bytes = block.dtype == np.uint8
            hint = f"; if eight pixels are in a byte, give the width {8 * self.columns}" if is_bytes else ""
            raise RecordingError(
                f"{self.path}: frames {begin} to {end - 1} have other values than 0 and 1: this is no array of "
                f"spikes{hint}"
            )
        return block.astype(np.uint8)


def is_array(head: bytes) -> bool:
    """Whether the first bytes of a file are those of a container that `open_array` reads."""
    return head.startswith((NUMPY_MAGIC, ZIP_MAGIC, HDF5_MAGIC))


def open_array(
    path: Path, name: str | None = None, width: int | None = None, bit_order: BitOrder | None = None
) -> SpikeArray:
    """Open the array [t, h, w] of 0 and 1, or uint8 [t, h, w / 8] of packed pixels, of an `.npy`, `.npz` or HDF5 file.

    `name` is needed where there are several. Packed arrays are recognised by their values, or by `width`; their
    leftmost pixel is in the highest bit unless `bit_order` says otherwise. Raises RecordingError.
    """
    stored = _array(path, name)
    if stored.ndim != 3 or min(stored.shape) < 1:
        raise RecordingError(
            f"{path}: its array has the shape {list(stored.shape)}: spikes are [frames, rows, columns]"
        )
    frames, height, columns = stored.shape
    if stored.dtype.kind not in "buif":
        raise RecordingError(f"{path}: its array has elements of {stored.dtype}: spikes are 0 and 1")
    if max(height, columns) > MOST_SIDE:
        raise RecordingError(f"{path}: frames of {columns}x{height} are larger than {MOST_SIDE} on a side")
    holds = width is not None and columns == -(-width // 8)
    packed = stored.dtype == np.uint8 and (holds or _largest(path, stored) > 1)
    if packed and width is not None and not holds:
        raise RecordingError(f"{path}: rows of {columns} bytes do not hold {width} pixels: correct the width")
    if not packed and width not in (None, columns):
        raise RecordingError(f"{path}: its array has {columns} columns, not {width}: correct the width")
    return _checked(
        SpikeArray(
            path,
            stored,
            frames,
            height,
            (width or 8 * columns) if packed else columns,
            (bit_order or BitOrder.MSB) if packed else None,
        )
    )


def open_bits(path: Path, width: int, height: int, bit_order: BitOrder | None = None) -> SpikeArray:
    """Open frames whose width * height bits follow one another, each frame filled up to a whole byte.

    Raises RecordingError.
    """
    if width < 8 or height < 1:
        raise RecordingError(
            f"{path}: frames of {width}x{height} pixels are impossible: correct the width and the height"
        )
    size = -(-width * height // 8)
    try:
        data = np.memmap(path, np.uint8, "r")
    except (OSError, ValueError) as error:
        raise RecordingError(f"{path}: cannot be read: {error}") from error
    frames = data.size // size
    if not frames:
        raise RecordingError(
            f"{path}: its {data.size} bytes are less than one frame of {width}x{height} ({size} bytes)"
        )
    stored = data[: frames * size].reshape(frames, size)
    trailing = data.size - frames * size
    return _checked(SpikeArray(path, stored, frames, height, width, bit_order or BitOrder.LSB, trailing))


def _block_frames(stored: Any) -> int:
    """Frames of the container to read at a time."""
    frame: int = math.prod(stored.shape[1:]) * stored.dtype.itemsize
    return max(1, min(BLOCK_FRAMES, BLOCK_BYTES // frame))


def _largest(path: Path, stored: Any) -> float:
    """The largest value of the first frames. Raises RecordingError."""
    try:
        return float(np.max(stored[: min(LOOKED_AT, _block_frames(stored))]))
    except UNREADABLE as error:
        raise RecordingError(f"{path}: its first frames cannot be read, the file is damaged: {error}") from error


def _checked(found: SpikeArray) -> SpikeArray:
    if not found.width:
        raise RecordingError(f"{found.path}: {found.columns} columns are too few: a recording has at least 8")
    return found


def _array(path: Path, name: str | None) -> Any:
    """The array of that name, or the only one with three axes."""
    try:
        with path.open("rb") as file:
            head = file.read(8)
        if head.startswith(NUMPY_MAGIC):
            if name is not None:
                raise RecordingError(f"{path}: it is one array without a name: leave the name out")
            return np.load(path, mmap_mode="r", allow_pickle=False)
        if head.startswith(ZIP_MAGIC):
            return _of_npz(path, name)
    except UNREADABLE as error:
        raise RecordingError(f"{path}: this is no readable array of NumPy: {error}") from error
    if head.startswith(HDF5_MAGIC):
        return _of_hdf5(path, name)
    raise RecordingError(f"{path}: this is neither a NumPy array nor an HDF5 file")


class _NpzArray:
    """An array of an `.npz` file, read in slices of frames from its beginning to its end, without unpacking it whole.

    Raises what `UNREADABLE` lists.
    """

    def __init__(self, path: Path, member: str) -> None:
        self._path, self._member = path, member
        self._opened = ExitStack()
        self._open()
        if self._header[1]:
            raise ValueError(f"{member} is stored by columns; save it with numpy.ascontiguousarray")
        self.shape, _, self.dtype = self._header

    @property
    def ndim(self) -> int:
        return len(self.shape)

    def _open(self) -> None:
        self._opened.close()
        archive = self._opened.enter_context(zipfile.ZipFile(self._path))
        self._file = self._opened.enter_context(archive.open(self._member))
        self._header = array_header(self._file)
        self._next = 0

    def __getitem__(self, frames: slice) -> NDArray[Any]:
        begin, end, _ = frames.indices(self.shape[0])
        if begin < self._next:
            self._open()
        frame = math.prod(self.shape[1:]) * self.dtype.itemsize
        while self._next < begin:
            self._next += 1
            self._file.read(frame)
        data = self._file.read((end - begin) * frame)
        if len(data) != (end - begin) * frame:
            raise RecordingError(f"{self._path}: {self._member} ends within frame {self._next + len(data) // frame}")
        self._next = end
        return np.frombuffer(data, self.dtype).reshape(end - begin, *self.shape[1:])


def _of_npz(path: Path, name: str | None) -> _NpzArray:
    axes = {}
    with zipfile.ZipFile(path) as file:
        members = [member for member in file.namelist() if member.endswith(".npy")]
        if len(members) > MOST_ARRAYS:
            raise RecordingError(
                f"{path}: it has {len(members)} arrays, more than {MOST_ARRAYS}: save the spikes alone"
            )
        for member in members:
            with file.open(member) as opened:
                axes[member.removesuffix(".npy")] = len(array_header(opened)[0])
    return _NpzArray(path, f"{_choose(path, axes, name)}.npy")


def _of_hdf5(path: Path, name: str | None) -> Any:
    try:
        import h5py
    except ImportError as error:
        raise RecordingError(f"{path}: HDF5 files need the package h5py: pip install 'spiked[hdf5]'") from error
    axes: dict[str, int] = {}
    try:
        file = h5py.File(path, "r")
        file.visititems(lambda key, item: axes.update({key: item.ndim}) if isinstance(item, h5py.Dataset) else None)
        found = file[_choose(path, axes, name)]
        if found.is_virtual or found.external:
            raise RecordingError(f"{path}: {found.name} is stored in other files: copy it into one file (h5repack)")
        if found.chunks is not None and math.prod(found.chunks) * found.dtype.itemsize > MOST_CHUNK_BYTES:
            raise RecordingError(
                f"{path}: {found.name} has chunks of {list(found.chunks)}, which are more than "
                f"{MOST_CHUNK_BYTES >> 20} MiB and unpacked as a whole: give it smaller ones (h5repack -l)"
            )
        return found
    except UNREADABLE as error:
        raise RecordingError(f"{path}: this is no readable HDF5 file: {error}") from error


def _choose(path: Path, axes: dict[str, int], name: str | None) -> str:
    """The name of the array to read, of arrays with so many `axes`."""
    if name is not None and name not in axes:
        raise RecordingError(f"{path}: there is no array {name!r}, only {', '.join(sorted(axes)) or 'none'}")
    fitting = [name] if name is not None else sorted(key for key, count in axes.items() if count == 3)
    if len(fitting) == 1:
        return fitting[0]
    if not fitting:
        raise RecordingError(f"{path}: it has no array with three axes: spikes are [frames, rows, columns]")
    raise RecordingError(f"{path}: it has several arrays, {', '.join(fitting)}: name one of them")
