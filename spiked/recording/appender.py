"""The growing end of a file of frames, written past the page cache.

Through the page cache a megapixel camera costs more than a core, spent on copies that nobody reads again.
"""

import errno
import mmap
import os
from contextlib import suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

_PAGE = 4096
"""What direct writes begin and end at: the block of most file systems, and a multiple of every disk's sector."""
_STAGED_BYTES = 4 << 20
_WORTHWHILE_BYTES = 64 << 10
"""Shorter direct writes wait for the disk more than they save."""


class Appender:
    """Appends to a file; what was appended is the kernel's, whatever becomes of this process. Used by one thread.

    Whole pages go to the disk directly (O_DIRECT), if the file system can do that; what is left at both ends of an
    append goes through the page cache. No page is written both ways, so that neither waits for the other.
    """

    def __init__(self, path: Path, *, resume: bool, direct: bool) -> None:
        """A new file, or with `resume` behind the end of one that exists. Raises OSError."""
        self._file = os.open(path, os.O_RDWR | os.O_CLOEXEC | (0 if resume else os.O_CREAT | os.O_EXCL), 0o666)
        self._direct: int | None = None
        self._staged = np.empty(0, np.uint8)
        if direct:
            with suppress(OSError):  # tmpfs of old kernels, some network file systems
                self._direct = os.open(path, os.O_WRONLY | os.O_CLOEXEC | os.O_DIRECT)
                self._staged = np.frombuffer(mmap.mmap(-1, _STAGED_BYTES), np.uint8)
        self.size = os.fstat(self._file).st_size
        self.direct_bytes = 0
        """How many went past the page cache."""

    def append(self, data: NDArray[np.uint8], cached: bool = False) -> None:
        """Bytes, uint8 [n]; all through the page cache if `cached`. Raises OSError; cut() takes back what was written
        before."""
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
            if written < piece:  # a full disk, which the rest will tell, or none for direct writes
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
            self._direct = None  # a file system that wants other pages
            return 0
        self.size += written
        self.direct_bytes += written
        return written

    def cut(self, size: int) -> None:
        """Cut the file to that size; space taken in advance is given back, too. Raises OSError."""
        os.ftruncate(self._file, size)
        self.size = size

    def fileno(self) -> int:
        """Descriptor, for syncing and for taking space."""
        return self._file

    def close(self) -> None:
        """Close the file."""
        os.close(self._file)
        if self._direct is not None:
            os.close(self._direct)
