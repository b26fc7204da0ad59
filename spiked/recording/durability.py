"""How hard a recording is held on to: its index, when it is synced, and the space it takes in advance."""

import ctypes
import errno
import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

_KEEP_SIZE = 1  # FALLOC_FL_KEEP_SIZE of <linux/falloc.h>: a killed writer leaves no zeros behind its last frame
_BEGIN_WRITE = 2  # SYNC_FILE_RANGE_WRITE of <linux/fs.h>: does not wait, and takes no error from who asks later
_EARLY_BYTES = 16 << 20
_PERIOD_S = 1.0
_libc = ctypes.CDLL(None, use_errno=True)


class Sync(StrEnum):
    """When written frames are forced from the kernel onto the disk. A kill loses nothing either way."""

    CLOSE = "close"
    """At the end; a power cut may lose all that the kernel had not written by itself."""
    SECOND = "second"
    """Every second, beside the writing; a power cut loses about that much."""
    BLOCK = "block"
    """After every write, which waits for it."""


@dataclass(frozen=True)
class Durability:
    """What a recording writer does beyond writing frames."""

    index: bool = False
    """Keep an index with checksums beside the frames."""
    sync: Sync = Sync.CLOSE
    preallocate_bytes: int = 0
    """Space taken from the disk ahead of the frames, and given back at the end."""
    reserve_bytes: int = 0
    """Free space that is left to others: when there is less, the disk counts as full."""
    direct: bool = False
    """Write past the page cache, at a fraction of the processor's time; an append then waits for the disk."""


PLAIN = Durability()
LIVE = Durability(index=True, sync=Sync.SECOND, preallocate_bytes=64 << 20, reserve_bytes=64 << 20, direct=True)
"""For cameras that do not wait."""


class Allocator:
    """Takes space ahead of a growing file, as far as the disk has it."""

    def __init__(self, file: int, durability: Durability, size: int) -> None:
        self._file = file
        self._step, self._reserve = _fitting(file, durability)
        self._checked = size
        self._allocated = size
        self._possible = self._step > 0

    def before(self, end: int) -> None:
        """To be called before the file grows to `end` bytes. Raises OSError ENOSPC when only the reserve is left."""
        if self._reserve and end > self._checked:
            stat = os.fstatvfs(self._file)
            left = stat.f_bavail * stat.f_frsize - (end - self._allocated)
            if left < self._reserve:
                raise OSError(errno.ENOSPC, f"the disk is full up to {self._reserve >> 20 or 1} MiB kept for others")
            # Looked at again well before the rest could be used up.
            self._checked = end + max((left - self._reserve) // 8, 1)
        if self._possible and end > self._allocated:
            size = max(self._step, end - self._allocated)
            if _libc.fallocate(self._file, _KEEP_SIZE, ctypes.c_int64(self._allocated), ctypes.c_int64(size)):
                # Too little space for a whole step, or a file system without the means: writing itself will tell.
                self._possible = ctypes.get_errno() == errno.EINTR
            else:
                self._allocated += size
        self._allocated = max(self._allocated, end)


def _fitting(file: int, durability: Durability) -> tuple[int, int]:
    """Step and reserve, made smaller on a small disk."""
    stat = os.fstatvfs(file)
    total = stat.f_blocks * stat.f_frsize
    return min(durability.preallocate_bytes, total // 32), min(durability.reserve_bytes, total // 20)


class Syncer:
    """Forces files onto the disk every second, on a thread of its own.

    In between it has the kernel begin to write what has come: the disk works while frames are copied, and a sync, the
    last one too, has little left to wait for.
    """

    def __init__(self, file: int, size: int, sync: Callable[[], None]) -> None:
        """`file` is the descriptor of the file that grows, now of `size` bytes."""
        self._file = file
        self._written = self._begun = size
        self._sync = sync
        self._over = threading.Event()
        self._wake = threading.Event()
        self._error: OSError | None = None
        self._thread = threading.Thread(target=self._run, name="sync", daemon=True)
        self._thread.start()

    def check(self) -> None:
        """Raise the OSError that syncing met, if it did."""
        if self._error is not None:
            raise self._error

    def written(self, size: int) -> None:
        """Tell how long the file is now."""
        self._written = size
        if size - self._begun >= _EARLY_BYTES:
            self._wake.set()

    def close(self) -> None:
        """End the thread, after the sync that may be going on."""
        self._over.set()
        self._wake.set()
        self._thread.join()

    def _run(self) -> None:
        due_s = time.monotonic() + _PERIOD_S
        while True:
            self._wake.wait(max(0.0, due_s - time.monotonic()))
            self._wake.clear()
            if self._over.is_set():
                return
            self._begin()
            if time.monotonic() < due_s:
                continue
            try:
                self._sync()
            except OSError as error:
                self._error = error
                return
            due_s = time.monotonic() + _PERIOD_S

    def _begin(self) -> None:
        """Only begins to write, so errors are left for the sync, which is told of them as well."""
        size = self._written - self._begun
        if size > 0:
            _libc.sync_file_range(self._file, ctypes.c_int64(self._begun), ctypes.c_int64(size), _BEGIN_WRITE)
            self._begun += size
