"""Deletes captures for good: gone at once for whoever reads, while a thread deletes their files and jobs."""

import threading

from spiked.errors import SpikedError
from spiked_service.reconstructions.notifier import Notifier
from spiked_service.reconstructions.repository import ReconstructionRepository
from spiked_service.store.catalogue import Catalogue, StoreError
from spiked_service.store.folder import DataFolder
from spiked_service.store.purges import Purges

_AT_ONCE = 32
"""Jobs whose rows are deleted in one transaction: some 3 ms, for which others who write wait."""
_OTHERS_S = 0.002
"""Time for others between two transactions."""
_RETRY_S = 60.0
"""Time after which a purge that has failed is tried again."""


class Purging:
    """Thread-safe. What says that a capture was purged is its renamed folder, so that a lost catalogue changes nothing.

    The order of the steps lets a kill between any two of them leave either the whole capture or none of it:

    1. the folder of the capture is renamed,
    2. one transaction deletes its row and hides its jobs; then `begin` returns,
    3. the recording is deleted; then jobs, the files of some before their rows,
    4. the renamed folder is deleted, last of all.

    A start goes on with what was renamed. A capture whose folder is back, from a backup, is no longer purged.
    """

    def __init__(
        self, folder: DataFolder, catalogue: Catalogue, rows: ReconstructionRepository, notifier: Notifier
    ) -> None:
        self._folder = folder
        self._catalogue = catalogue
        self._purges = Purges(catalogue)
        self._rows = rows
        self._notifier = notifier
        self._wake = threading.Event()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="purges", daemon=True)

    def start(self) -> None:
        """Go on with what an earlier service began. Call once."""
        self._wake.set()
        self._thread.start()

    def begin(self, capture_id: str) -> None:
        """Purge a capture; its files and jobs are deleted soon. Raises StoreError, and then it has not changed."""
        try:
            self._folder.begin_purge(capture_id)
        except OSError as error:
            raise StoreError(f"capture {capture_id} cannot be deleted: {error.strerror}") from error
        try:
            self._catalogue.freeing(self._purges.begin, capture_id)
        except BaseException:
            self._folder.undo_purge(capture_id)
            raise
        self._wake.set()

    def close(self) -> None:
        """End the thread; the next start goes on."""
        self._closing.set()
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join()

    def _run(self) -> None:
        wait_s = None
        while True:
            self._wake.wait(wait_s)
            self._wake.clear()
            if self._closing.is_set():
                return
            wait_s = None
            try:
                for capture_id in self._purges.ids():
                    if self._closing.is_set():
                        return
                    self._finish(capture_id)
            except (SpikedError, OSError) as error:
                self._notifier.log("error", f"purged captures are not deleted yet, which will be retried: {error}")
                wait_s = _RETRY_S

    def _finish(self, capture_id: str) -> None:
        if capture_id in self._folder.purged():
            self._folder.empty_purged(capture_id)
        while ids := self._purges.some_jobs(capture_id, _AT_ONCE):
            self._rows.clear(ids)
            if self._closing.wait(_OTHERS_S):
                return
        self._folder.end_purge(capture_id)
        self._catalogue.freeing(self._purges.end, capture_id)


def resume_purges(folder: DataFolder, catalogue: Catalogue) -> None:
    """Bring the catalogue in step with the folders of purged captures, at the start, before anything else reads it.

    Raises StoreError.
    """
    purges, marked = Purges(catalogue), folder.purged()
    known = set(purges.ids())
    for capture_id in marked - known:
        purges.begin(capture_id)
    for capture_id in known - marked:
        if folder.capture(capture_id).exists():
            purges.end(capture_id)
