"""Recordings in the object store of a service: each once, however many attempts read it."""

import os
import threading
import time
from collections.abc import Callable
from pathlib import Path

from spiked_service.cluster.job_files import files_in
from spiked_service.cluster.messages import StoredFile
from spiked_service.cluster.object_store import ObjectStore, sha256_of

KEEP_S = 600.0
"""How long a recording stays after the last attempt that reads it: a queue has many jobs of one recording."""
_LOOK_S = 0.5
"""Interval at which who waits for another attempt's upload looks whether it is still wanted."""
_MOST_HASHES = 100_000
"""Files whose hash is remembered."""


class SharedRecordings:
    """Stores the files of recordings by their SHA-256, and removes those that no attempt reads. Thread-safe."""

    def __init__(self, store: ObjectStore, keep_s: float = KEEP_S) -> None:
        self.store = store
        self._keep_s = keep_s
        self._lock = threading.Condition()
        self._held: dict[str, set[str]] = {}
        """Hashes that an attempt reads."""
        self._unknown: set[str] = set()
        """Attempts of an earlier service, which may read any of them."""
        self._used_s: dict[str, float] = {}
        """When the last attempt that read it has ended, or it was seen first."""
        self._busy: set[str] = set()
        """Hashes that are being stored or removed."""
        self._hashing = threading.Lock()
        self._hashes: dict[tuple[str, int, int, int], str] = {}
        """By path, size, time of change and inode of a file."""

    def hold(self, folder: Path, attempt: str, check: Callable[[], None] = lambda: None) -> list[StoredFile]:
        """Store what is not yet there of a recording's folder; it stays there until the attempt is released.

        `check` raises once that is wanted no more. Raises what it raises, ObjectStoreError and OSError.
        """
        found = []
        for path in files_in(folder):
            name = path.relative_to(folder).as_posix()
            stored = StoredFile(name=name, bytes=path.stat().st_size, sha256=self._hash(path))
            with self._lock:
                self._held.setdefault(attempt, set()).add(stored.sha256)
                while stored.sha256 in self._busy:
                    self._lock.wait(_LOOK_S)
                    check()
                self._busy.add(stored.sha256)
            try:
                store = self.store.until(check)
                if not store.has(stored.sha256, stored):
                    store.put_file(path, stored.sha256, stored)
            finally:
                self._free(stored.sha256)
            found.append(stored)
        return found

    def hold_all(self, attempt: str) -> None:
        """An attempt of an earlier service has begun, whose recording is not known here."""
        with self._lock:
            self._unknown.add(attempt)

    def release(self, attempt: str) -> None:
        """An attempt is over."""
        with self._lock:
            self._unknown.discard(attempt)
            for sha256 in self._held.pop(attempt, ()):
                self._used_s[sha256] = time.monotonic()

    def sweep(self) -> int:
        """Remove what no attempt has read for a while. Return how many objects. Raises ObjectStoreError."""
        swept = 0
        for sha256 in self.store.objects():
            with self._lock:
                held = self._unknown or sha256 in self._busy or any(sha256 in one for one in self._held.values())
                unused_s = time.monotonic() - self._used_s.setdefault(sha256, time.monotonic())
                if held or unused_s < self._keep_s:
                    continue
                self._busy.add(sha256)
            try:
                self.store.below(sha256).remove()
                swept += 1
            finally:
                self._free(sha256)
        return swept

    def is_left(self, sha256: str) -> bool:
        """Whether an upload of a recording that was listed before is nobody's: one that goes on is this service's."""
        with self._lock:
            return sha256 not in self._busy

    def _free(self, sha256: str) -> None:
        with self._lock:
            self._busy.discard(sha256)
            self._lock.notify_all()

    def _hash(self, path: Path) -> str:
        """The hash of a file that has not changed is not computed again: a recording is large and has many jobs."""
        with self._hashing:
            stat = path.stat()
            key = (os.fspath(path), stat.st_size, stat.st_mtime_ns, stat.st_ino)
            if key not in self._hashes:
                if len(self._hashes) >= _MOST_HASHES:
                    self._hashes.clear()
                self._hashes[key] = sha256_of(path)
            return self._hashes[key]
