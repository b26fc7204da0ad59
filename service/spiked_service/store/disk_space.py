"""Reserves space on the disk of the data folder for captures and uploads."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from spiked.recording.durability import LIVE, kept_for_others
from spiked.sensor import Sensor
from spiked_service.store.catalogue import Catalogue, StoreError
from spiked_service.store.folder import DataFolder
from spiked_service.store.rows import Plan

_LEAST_BYTES = 64 << 20
"""Space reserved for an unlimited capture; less on a small disk."""
_CAPTURES_RESERVE_BYTES = 256 << 20
"""Space that uploads leave for captures; less on a small disk."""
_INDEX_BYTES = 4
"""Index size per frame: an entry of 32 bytes covers at least 8 frames."""
_SIDECAR_BYTES = 1 << 20
"""Sidecar with its reserve, logs and thumbnail."""


class DiskFullError(StoreError):
    """A capture, upload or export exceeds the free space, without what is reserved."""


class DiskSpace:
    """Reserves no more than the free space. A reservation shrinks as its file grows. Thread-safe.

    Recorders stop at `Durability.reserve_bytes` of free space, which is never reserved.
    """

    def __init__(self, folder: DataFolder, catalogue: Catalogue) -> None:
        self._folder = folder
        self._catalogue = catalogue
        self._lock = threading.Lock()
        self._recordings: dict[Path, int] = {}

    @property
    def storable_bytes(self) -> int:
        """Bytes that captures can write now, without regard to reservations."""
        space = self._folder.space()
        return max(0, space.free_bytes - kept_for_others(LIVE, space.total_bytes))

    @property
    def least_bytes(self) -> int:
        """Least free space for a capture."""
        return min(_LEAST_BYTES, self._folder.space().total_bytes // 32)

    def reserve_recording(self, path: Path, size: int | None) -> None:
        """Reserve `size` bytes for a recording; None: unlimited. Raises DiskFullError."""
        needed = self.least_bytes if size is None else size
        with self._lock:
            free = self.storable_bytes - self._reserved()
            if needed > free:
                whose = "an unlimited capture needs" if size is None else "this capture needs"
                raise DiskFullError(
                    f"{whose} {readable_bytes(needed)}, and {readable_bytes(max(0, free))} are free for captures at "
                    f"{self._folder.path}{self._others()}: free disk space, or capture less"
                )
            self._recordings[path] = needed

    def release(self, path: Path) -> None:
        """Release the reservation of a closed recording."""
        with self._lock:
            self._recordings.pop(path, None)

    @contextmanager
    def for_upload(self, size: int) -> Iterator[None]:
        """Check the space for an upload; no other reservation is made until the context exits.

        Raises DiskFullError.
        """
        with self._lock:
            self._refuse_upload(size)
            yield

    def reserve_converted(self, path: Path, size: int) -> None:
        """Reserve `size` bytes for the recording that an upload is converted to. Raises DiskFullError."""
        with self._lock:
            self._refuse_upload(size)
            self._recordings[path] = size

    def _refuse_upload(self, size: int) -> None:
        left = min(_CAPTURES_RESERVE_BYTES, self._folder.space().total_bytes // 10)
        free = self.storable_bytes - left - self._reserved()
        if size > free:
            raise DiskFullError(
                f"{size} bytes do not fit: the disk of {self._folder.path} has {max(0, free)} bytes free for "
                f"uploads{self._others()}: free disk space, or send it later"
            )

    def _others(self) -> str:
        reserved = self._reserved()
        return (
            f" beside the {readable_bytes(reserved)} that running captures and uploads still need" if reserved else ""
        )

    def _reserved(self) -> int:
        wanted = dict(self._recordings)
        for row in self._catalogue.uploads.where():
            if row.capture_id is None:
                wanted[self._folder.upload(row.id)] = row.bytes
        return sum(max(0, size - _allocated(path)) for path, size in wanted.items())


def recording_bytes(plan: Plan, sensor: Sensor, frames: int | None) -> int | None:
    """Bytes of the recording of a plan, with index and sidecar, from a source of `frames`; None if unlimited."""
    length = plan.frames if plan.seconds is None else max(1, round(plan.seconds * sensor.frame_rate_hz))
    ends = [end for end in (length, frames) if end is not None]
    if not ends:
        return None
    count = min(ends) + round(plan.pretrigger_s * sensor.frame_rate_hz)
    return count * (sensor.compact().frame_bytes + _INDEX_BYTES) + _SIDECAR_BYTES


def readable_bytes(size: int) -> str:
    """A size in MB or GB."""
    return f"{size / 1e9:.1f} GB" if size >= 1e9 else f"{size / 1e6:.1f} MB"


def _allocated(path: Path) -> int:
    """Bytes that a file occupies on the disk, with those preallocated beyond its end."""
    try:
        return path.stat().st_blocks * 512
    except FileNotFoundError:
        return 0
