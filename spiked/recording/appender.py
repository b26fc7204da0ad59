"""Appends frames to a file with direct writes, past the page cache.

Through the page cache, a megapixel camera costs more than one core, for copies that are not read again.
"""

import errno
import mmap
import os
from contextlib import suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

_PAGE = 4096
"""Alignment of direct writes, bytes: the block of most file systems, a multiple of every disk's sector."""
_STAGED_BYTES = 4 << 20
"""Size of the aligned buffer for direct writes."""
_WORTHWHILE_BYTES = 64 << 10
"""Least size of a direct write: shorter ones cost more in waiting for the disk than they save."""


class Appender:
    """Appends to a file. Appended bytes are with the kernel and survive the death of this process. Used by one thread.

    Whole pages are written directly (O_DIRECT) if the file system supports it; the rest at both ends of an append goes
    through the page cache. No page is written both ways, so that neither waits for the other.
    """

    def __init__(self, path: Path, *, resume: bool, direct: bool) -> None:
        """Create a file, or with `resume` append to an existing one. Raises OSError."""
        self._file = os.open(path, os.O_RDWR | os.O_CLOEXEC | (0 if resume else os.O_CREAT | os.O_EXCL), 0o666)
        self._direct: int | None = None
        self._staged = np.empty(0, np.uint8)
        if direct:
            with suppress(OSError):  # tmpfs of old kernels, some network file systems
                self._direct = os.open(path, os.O_WRONLY | os.O_CLOEXEC | os.O_DIRECT)
                self._staged = np.frombuffer(mmap.mmap(-1, _STAGED_BYTES), np.uint8)
        self.size = os.fstat(self._file).st_size
        self.direct_bytes = 0
        """Bytes written past the page cache."""

    def append(self, data: NDArray[np.uint8], cached: bool = False) -> None:
        """Append bytes, uint8 [n]; through the page cache if `cached`. Raises OSError; `cut` then removes a part."""
        before = -self.size % _PAGE
        whole = max(len(data) - before, 0) // _PAGE * _PAGE
        if cached or whole < _WORTHWHILE_BYTES:
            before, whole = len(data), 0
        self._write(data[:before])
        end = before + whole
        while before < end and self._direct is not None:
            piece = min(end - before, _STAGED_BYTES)
            self._staged[:piece] = data[before : before + piece]
            written = self._write_directly(self._direct, piece)
            before += written
            if written < piece:  # a full disk, which the next write reports, or no direct writes
                break
        self._write(data[before:])

    def _write(self, data: NDArray[np.uint8]) -> None:
        rest = data.data
        while rest:
            written = os.pwrite(self._file, rest, self.size)
            self.size += written
            rest = rest[written:]

    def _write_directly(self, file: int, count: int) -> int:
        try:
            written = os.pwrite(file, self._staged[:count].data, self.size)
        except OSError as error:
            if error.errno != errno.EINVAL:
                raise
            os.close(file)
            self._direct = None  # the file system needs another alignment
            return 0
        self.size += written
        self.direct_bytes += written
        return written

    def cut(self, size: int) -> None:
        """Truncate the file and release preallocated space. Raises OSError."""
        os.ftruncate(self._file, size)
        self.size = size

    def fileno(self) -> int:
        """Its descriptor, for syncing and preallocation."""
        return self._file

    def close(self) -> None:
        """Close the file."""
        os.close(self._file)
        if self._direct is not None:
            os.close(self._direct)
