"""Space on the disk that is kept for the moment when it is full."""

import os
from pathlib import Path

_BYTES = 1 << 20
"""Size of the file: room for about a hundred changes of the catalogue. Less on a small disk."""
_SHARE = 64
"""The disk is at least so many times larger."""


class DiskReserve:
    """A file that is removed when the disk is full, so that what frees space has the room that it needs."""

    def __init__(self, path: Path) -> None:
        """Nothing is kept before `keep`."""
        self._path = path

    def keep(self) -> bool:
        """Make the file if there is room for two of it; returns whether it is there."""
        if self._path.exists():
            return True
        try:
            disk = os.statvfs(self._path.parent)
            size = min(_BYTES, disk.f_blocks * disk.f_frsize // _SHARE)
            if disk.f_bavail * disk.f_frsize < 2 * size:
                return False
            with self._path.open("wb") as file:
                os.posix_fallocate(file.fileno(), 0, size)
        except OSError:
            self._path.unlink(missing_ok=True)  # filled meanwhile, or read-only
            return False
        return True

    def give_up(self) -> bool:
        """Remove the file; returns whether there was one."""
        try:
            self._path.unlink()
        except OSError:
            return False
        return True
