"""Durability of a recording: its index, syncing to disk, and preallocated space."""

import ctypes
import errno
import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

_KEEP_SIZE = 1  # FALLOC_FL_KEEP_SIZE of <linux/falloc.h>: no zeros follow the last frame of a killed writer
_BEGIN_WRITE = 2  # SYNC_FILE_RANGE_WRITE of <linux/fs.h>: does not wait, and does not consume errors
EARLY_BYTES = 16 << 20
"""Written bytes after which writeback starts before the next sync."""
SYNC_PERIOD_S = 1.0
"""Time between syncs of `Sync.SECOND`, seconds."""
_libc = ctypes.CDLL(None, use_errno=True)


class Sync(StrEnum):
    """When written frames are synced from the kernel to the disk. A killed process loses none of them."""

    CLOSE = "close"
    """At the end. A power failure may lose all that the kernel had not written yet."""
    SECOND = "second"
    """Every second, in parallel with writing. A power failure loses about one second."""
    BLOCK = "block"
    """After every write, which waits for the sync."""


@dataclass(frozen=True)
class Durability:
    """Options of a recording writer."""

    index: bool = False
    """Keep an index with checksums beside the frames."""
    sync: Sync = Sync.CLOSE
    preallocate_bytes: int = 0
    """Step by which disk space is allocated ahead of the frames; the rest is released at the end."""
    reserve_bytes: int = 0
    """Free space kept for other programs: with less, the disk counts as full."""
    direct: bool = False
    """Write past the page cache, with a fraction of the CPU time; an append then waits for the disk."""


PLAIN = Durability()
"""For programs that can write a recording again."""
LIVE = Durability(index=True, sync=Sync.SECOND, preallocate_bytes=64 << 20, reserve_bytes=64 << 20, direct=True)
"""For live cameras."""


def kept_for_others(durability: Durability, total_bytes: int) -> int:
    """Bytes that a writer leaves free on a disk of `total_bytes`."""
    return min(durability.reserve_bytes, total_bytes // 20)


class Allocator:
    """Allocates disk space ahead of a growing file, and keeps a reserve free."""

    def __init__(self, file: int, durability: Durability, size: int) -> None:
        self._file = file
        self._step, self._reserve = _fitting(file, durability)
        self._checked = size
        self._allocated = size
        self._possible = self._step > 0

    def before(self, end: int) -> None:
        """Call before the file grows to `end` bytes. Raises OSError ENOSPC if only the reserve is left."""
        if self._reserve and end > self._checked:
            stat = os.fstatvfs(self._file)
            left = stat.f_bavail * stat.f_frsize - (end - self._allocated)
            if left < self._reserve:
                raise OSError(
                    errno.ENOSPC, f"the disk is full except for {self._reserve >> 20 or 1} MiB kept for other programs"
                )
            # The next check is well before the free space can be used up.
            self._checked = end + max((left - self._reserve) // 8, 1)
        if self._possible and end > self._allocated:
            size = max(self._step, end - self._allocated)
            if _libc.fallocate(self._file, _KEEP_SIZE, ctypes.c_int64(self._allocated), ctypes.c_int64(size)):
                # Too little space for a step, or not supported by the file system: the write reports a full disk.
                self._possible = ctypes.get_errno() == errno.EINTR
            else:
                self._allocated += size
        self._allocated = max(self._allocated, end)

    def cut(self, end: int) -> None:
        """Call after the file was cut to `end` bytes: what was allocated behind them is free again."""
        self._checked, self._allocated = min(self._checked, end), min(self._allocated, end)


def _fitting(file: int, durability: Durability) -> tuple[int, int]:
    """Step and reserve in bytes, reduced on a small disk."""
    stat = os.fstatvfs(file)
    total = stat.f_blocks * stat.f_frsize
    return min(durability.preallocate_bytes, total // 32), kept_for_others(durability, total)


def begin_write(file: int, offset: int, size: int) -> None:
    """Start writeback of a range of bytes of an open file to the disk, without waiting."""
    _libc.sync_file_range(file, ctypes.c_int64(offset), ctypes.c_int64(size), _BEGIN_WRITE)


class Syncer:
    """Syncs files to the disk every second, on a thread of its own.

    In between it starts writeback of new bytes, so that the disk works while frames are copied and each sync has little
    left to write.
    """

    def __init__(self, file: int, size: int, sync: Callable[[], None]) -> None:
        """`file` is the descriptor of the growing file, `size` its present length in bytes."""
        self._file = file
        self._written = self._begun = size
        self._sync = sync
        self._over = threading.Event()
        self._wake = threading.Event()
        self._error: OSError | None = None
        self._thread = threading.Thread(target=self._run, name="sync", daemon=True)
        self._thread.start()

    def check(self) -> None:
        """Raise the OSError of the sync thread, if there was one."""
        if self._error is not None:
            raise self._error

    def written(self, size: int) -> None:
        """State the present length of the file."""
        self._written = size
        if size - self._begun >= EARLY_BYTES:
            self._wake.set()

    def close(self) -> None:
        """End the thread, after a running sync."""
        self._over.set()
        self._wake.set()
        self._thread.join()

    def _run(self) -> None:
        due_s = time.monotonic() + SYNC_PERIOD_S
        while True:
            self._wake.wait(max(0.0, due_s - time.monotonic()))
            self._wake.clear()
            if self._over.is_set():
                return
            self._start_writeback()
            if time.monotonic() < due_s:
                continue
            try:
                self._sync()
            except OSError as error:
                self._error = error
                return
            due_s = time.monotonic() + SYNC_PERIOD_S

    def _start_writeback(self) -> None:
        """Start writeback. Its errors are reported by the next sync."""
        size = self._written - self._begun
        if size > 0:
            begin_write(self._file, self._begun, size)
            self._begun += size
