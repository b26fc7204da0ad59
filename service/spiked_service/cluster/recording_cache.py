"""Recordings on the disk of a machine that works for jobs: fetched once for all attempts there that read them."""

import fcntl
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from spiked.errors import RecordingError
from spiked.recording import index_path, read_index
from spiked.recording.recover import damaged_blocks
from spiked_service.cluster.messages import StoredFile
from spiked_service.cluster.object_store import sha256_of
from spiked_service.cluster.scratch import scratch_base

_READ_ONLY = 0o440
"""Mode of a file in the cache, which several attempts read."""
_PART = ".part"
"""Suffix of a file that is being fetched."""
_LOCK = ".lock"
"""Suffix of the files that are locked: one for each beginning of a hash, and one for the room."""


class RecordingCache:
    """Files named by their SHA-256, the least recently used of which make room. Safe for several processes.

    An attempt gets a link, so that what is removed meanwhile stays there for it.
    """

    def __init__(self, folder: Path, most_bytes: int, fetch: Callable[[StoredFile, Path], None]) -> None:
        """`fetch` writes a file, which appears whole. The cache takes no more than half of the room that there is.

        Raises OSError for a folder that is not this user's.
        """
        self._folder = folder
        self._most_bytes = most_bytes
        self._fetch = fetch
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if folder.is_symlink() or folder.stat().st_uid != os.getuid():
            raise PermissionError(f"{folder} is another user's")

    def put_into(self, folder: Path, files: list[StoredFile]) -> None:
        """Bring the files of a recording into a folder. Raises what `fetch` raises, and OSError."""
        folder.mkdir(parents=True, exist_ok=True)
        known = [stored for stored in files if not self._provide(folder, stored)]
        for stored in known:
            path = folder / stored.name
            if not _is_whole(path, stored):
                with self._locked(stored.sha256[:2]):
                    self._entry(stored).unlink(missing_ok=True)
                path.unlink()
                self._provide(folder, stored)

    def _provide(self, folder: Path, stored: StoredFile) -> bool:
        """Bring a file into a folder. Return whether it was fetched, which checks it."""
        entry, target = self._entry(stored), folder / stored.name
        target.parent.mkdir(parents=True, exist_ok=True)
        with self._locked(stored.sha256[:2]):  # of several agents one fetches it
            with suppress(FileNotFoundError):
                os.link(entry, target)
                os.utime(entry)
                return False
            if not self._make_room(stored.bytes):
                self._fetch(stored, target)
                return True
            self._fetch(stored, entry)
            entry.chmod(_READ_ONLY)
            os.link(entry, target)
        self._make_room(0)  # others may have fetched at the same time
        return True

    def _make_room(self, wanted: int) -> bool:
        """Remove what was used least recently. Return whether there is room for so many bytes."""
        with self._locked("room"):
            entries, used = [], 0
            for path in self._folder.iterdir():
                if path.suffix == _PART:
                    self._remove_if_left(path)
                elif path.suffix != _LOCK:
                    with suppress(FileNotFoundError):
                        stat = path.stat()
                        entries.append((stat.st_mtime_ns, stat.st_size, path))
                        used += stat.st_size
            disk = os.statvfs(self._folder)
            most = min(self._most_bytes, used + disk.f_bavail * disk.f_frsize // 2)
            if wanted > most:
                return False
            for _, size, path in sorted(entries):
                if used + wanted <= most:
                    break
                path.unlink(missing_ok=True)
                used -= size
            return True

    def _remove_if_left(self, part: Path) -> None:
        """Remove what an agent has left that was killed while it fetched."""
        with suppress(BlockingIOError), self._locked(part.name[:2], fcntl.LOCK_EX | fcntl.LOCK_NB):
            part.unlink(missing_ok=True)

    def _entry(self, stored: StoredFile) -> Path:
        return self._folder / stored.sha256

    @contextmanager
    def _locked(self, name: str, how: int = fcntl.LOCK_EX) -> Iterator[None]:
        """A lock among processes, which the kernel lets go of when its owner dies."""
        with (self._folder / f"{name}{_LOCK}").open("w") as lock:
            fcntl.flock(lock, how)
            yield


def cache_folder() -> Path:
    """The folder of the cache, beside the folders of attempts: links do not go from one file system to another."""
    return scratch_base() / f"spiked-recordings-{os.getuid()}"


def _is_whole(path: Path, stored: StoredFile) -> bool:
    """Whether a file is as it was stored: by the checksums of its index, which are fast, else by its hash."""
    return path.stat().st_size == stored.bytes and (_agrees_with_index(path) or sha256_of(path) == stored.sha256)


def _agrees_with_index(path: Path) -> bool:
    index = index_path(path)
    if index == path or not index.exists():
        return False
    try:
        known = read_index(index)
        stored = int(known.blocks["count"].sum()) * known.frame_bytes
        return stored == path.stat().st_size and not damaged_blocks(path, known)
    except RecordingError:
        return False
