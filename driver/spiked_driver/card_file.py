"""The path that a capture card is read from: opened, lost after a failed read, and opened again."""

import errno
import fcntl
import os
import select
import stat
import time
from contextlib import suppress
from pathlib import Path

from spiked.errors import SourceError
from spiked.ring import DeviceState, DeviceStatus, LossCause
from spiked_driver.source import READ_WAIT_S

SILENCE_S = 1.0
"""Seconds without a byte after which a camera counts as lost: it sends all the time."""
PIPE_BYTES = 1 << 20
"""Size that is asked for of a pipe, the most that Linux grants to everyone."""
_NOT_THERE = frozenset({errno.ENOENT, errno.ENXIO, errno.ENODEV, errno.ENOTDIR})
"""Errors of a card that is not plugged in, or whose driver is not loaded."""


def absence(path: Path) -> str:
    """Why nothing is read from a path that does not exist."""
    return f"there is no {path}: check the path, the capture card and its driver"


class CardFile:
    """A device node, a pipe or a file. `status` is that of the device; the owner sets it while frames come."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.status = DeviceStatus(DeviceState.IDLE)
        self.was_absent = False
        """The path was missing since the last read."""
        self._file: int | None = None
        self._ends = False
        self._opened = False
        self._bytes_s = 0.0

    @property
    def is_open(self) -> bool:
        """Whether the path is open. Raises SourceError if it was never opened."""
        if not self._opened:
            raise SourceError(f"{self.path}: the source is not open: open it before reading")
        return self._file is not None

    def open(self) -> None:
        """Open the path, if it is there. Raises SourceError if it is and cannot be read."""
        self._opened = True
        error = self._try_open()
        if error is not None:
            raise SourceError(f"{self.path}: cannot be read: {error}; check the path and its permissions")

    def reopen(self) -> None:
        """Wait READ_WAIT_S, then try to open the path."""
        time.sleep(READ_WAIT_S)
        error = self._try_open()
        if error is not None:
            self.status = DeviceStatus(DeviceState.LOST, f"{self.path}: cannot be read: {error}")

    def close(self) -> None:
        """Close the path."""
        self._opened = False
        self._release()
        self.status = DeviceStatus(DeviceState.IDLE)

    def read_into(self, block: bytearray) -> int | None:
        """Read the next bytes. Their number; 0 at the end of a file or pipe; None if none came within READ_WAIT_S.

        Raises OSError, also at the end of a device, which has none.
        """
        assert self._file is not None, "checked by the caller"
        if not select.select([self._file], [], [], READ_WAIT_S)[0]:
            self._notice_silence()
            return None
        try:
            count = os.readv(self._file, [block])
        except BlockingIOError:
            return None
        if not count and not self._ends:
            raise OSError(errno.EIO, "the device sends an end")
        self._bytes_s = time.monotonic()
        return count

    def lose(self, error: OSError) -> LossCause:
        """Close the path after a failed read; returns whose loss it is."""
        self._release()
        self.was_absent = False
        self.status = DeviceStatus(DeviceState.LOST, f"{self.path}: reading failed: {error.strerror}")
        return LossCause.DEVICE if error.errno in _NOT_THERE else LossCause.USB

    def _try_open(self) -> str | None:
        """Open the path, or note that it is absent. Returns the error if it is there and cannot be opened."""
        try:
            file = os.open(self.path, os.O_RDONLY | os.O_NONBLOCK)
        except OSError as error:
            if error.errno not in _NOT_THERE:
                return error.strerror or str(error)
            self.was_absent = True
            self.status = DeviceStatus(DeviceState.ABSENT, absence(self.path))
            return None
        mode = os.fstat(file).st_mode
        if stat.S_ISDIR(mode):
            os.close(file)
            return "it is a folder"
        self._ends = stat.S_ISREG(mode) or stat.S_ISFIFO(mode)
        if stat.S_ISFIFO(mode):
            with suppress(OSError):  # a smaller pipe works, with more reads
                fcntl.fcntl(file, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
        self._file = file
        self._bytes_s = time.monotonic()
        self.status = DeviceStatus(DeviceState.ARMED, self.status.reason)
        return None

    def _notice_silence(self) -> None:
        if self.status.state is DeviceState.STREAMING and time.monotonic() - self._bytes_s > SILENCE_S:
            self.status = DeviceStatus(DeviceState.LOST, f"{self.path}: nothing was sent for {SILENCE_S:g} s")

    def _release(self) -> None:
        if self._file is not None:
            os.close(self._file)
            self._file = None
