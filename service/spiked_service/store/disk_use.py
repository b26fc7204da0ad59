"""Bytes on disk by capture: measured once, and then where something has changed."""

import os
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

from spiked_service.store.catalogue import NOT_PURGED, Catalogue
from spiked_service.store.folder import DataFolder
from spiked_service.store.rows import CaptureState, JobState

_AGAIN = 500
"""Folders that are measured again each time although no row tells of a change: somebody may have changed files."""


class DiskUse:
    """What captures take, with their reconstructions. Not thread-safe.

    The first measurement walks all folders. Later ones walk those whose rows were written since, those of what runs,
    and `_AGAIN` of the others in turn.
    """

    def __init__(self, folder: DataFolder, catalogue: Catalogue) -> None:
        self._folder = folder
        self._catalogue = catalogue
        self._used: dict[str, dict[str, int]] = {}
        """By capture: bytes of its folder, and of those of its reconstructions."""
        self._capture_of: dict[str, str] = {}
        """The capture of each reconstruction."""
        self._others: Iterator[str] = iter(())

    def by_capture(self) -> dict[str, int]:
        """Bytes of each capture that is there. Raises StoreError."""
        with self._catalogue.transaction():
            written = self._catalogue.written.take()
        for row_id in self._all() if written is None else {*written, *self._running(), *islice(self._others, _AGAIN)}:
            self._measure(row_id)
        if next(self._others, None) is None:
            self._others = iter([one for used in self._used.values() for one in used])
        return {capture_id: sum(used.values()) for capture_id, used in self._used.items()}

    def forget(self) -> None:
        """Nobody asks any more; the next measurement is a first one."""
        with self._catalogue.transaction():
            self._catalogue.written.stop()
        self._clear()

    def _clear(self) -> None:
        self._used.clear()
        self._capture_of.clear()
        self._others = iter(())

    def _all(self) -> list[str]:
        self._clear()
        found = self._catalogue.read(f"SELECT id FROM captures UNION ALL SELECT id FROM jobs WHERE {NOT_PURGED}")
        return [row_id for (row_id,) in found]

    def _running(self) -> list[str]:
        over = tuple(str(state) for state in CaptureState if state.over)
        captures = f"SELECT id FROM capture_list WHERE state NOT IN ({', '.join('?' * len(over))})"
        jobs = "SELECT id FROM jobs WHERE state = ?"
        found = self._catalogue.read(f"{captures} UNION ALL {jobs}", (*over, str(JobState.RUNNING)))
        return [row_id for (row_id,) in found]

    def _measure(self, row_id: str) -> None:
        """Measure a folder of a capture or of a reconstruction, or forget one that is gone."""
        job = f"SELECT capture_id FROM jobs WHERE id = ?1 AND {NOT_PURGED}"
        query = f"SELECT id FROM capture_list WHERE id = ?1 UNION ALL {job}"
        found = self._catalogue.read(query, (row_id,))
        if not found:
            self._used.pop(row_id, None)
            self._used.get(self._capture_of.pop(row_id, ""), {}).pop(row_id, None)
            return
        ((capture_id,),) = found
        if capture_id == row_id:
            folder = self._folder.capture(row_id)
        else:
            folder = self._folder.reconstruction(row_id)
            self._capture_of[row_id] = capture_id
        self._used.setdefault(capture_id, {})[row_id] = size_of(folder)


def size_of(folder: Path) -> int:
    """Bytes that the files below a folder occupy; 0 if there is none."""
    total, folders = 0, [f"{folder}"]
    while folders:
        try:
            with os.scandir(folders.pop()) as entries:
                for entry in entries:
                    if entry.is_dir(follow_symlinks=False):
                        folders.append(entry.path)
                    stat = entry.stat(follow_symlinks=False)
                    total += stat.st_blocks * 512 // max(1, stat.st_nlink)  # a job links the maps that it uses
        except FileNotFoundError:
            continue  # a running reconstruction lets go of versions
    return total
