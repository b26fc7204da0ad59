"""Everything that lasts, put together: data folder, catalogue, captures, reconstructions, and who cleans up."""

import threading
from collections.abc import Callable
from pathlib import Path

from spiked.errors import SpikedError
from spiked_service.announcer import Announcer
from spiked_service.captures import Captures
from spiked_service.config import Settings
from spiked_service.health import Verdict
from spiked_service.reconstructions import Reconstructions
from spiked_service.store.catalogue import Catalogue
from spiked_service.store.folder import DataFolder
from spiked_service.store.retention import Policy, Retention

_CLEAN_S = 60.0
_SCARCE_BYTES = 1 << 30


class Keeping:
    """Owns the data folder as long as the service runs."""

    def __init__(self, data: Path | None, announce: Announcer) -> None:
        """Take up what an earlier service left. Raises ConfigurationError or StoreError."""
        self.folder = DataFolder(data)
        try:
            self.folder.sweep()
            self.catalogue = Catalogue(self.folder.catalogue)
        except BaseException:
            self.folder.close()
            raise
        self._announce = announce
        self.reconstructions = Reconstructions(self.folder, self.catalogue, announce)
        self.captures = Captures(self.folder, self.catalogue, self.reconstructions, announce)
        self.retention = Retention(self.folder, self.catalogue, self.captures, lambda text: announce.log("info", text))
        self._over = threading.Event()
        self._cleaner = threading.Thread(target=self._clean, name="retention", daemon=True)
        self._recovered = False
        self._cleaner.start()

    def configure(self, settings: Settings) -> None:
        """Take limits, now or when they change."""
        self.reconstructions.limit = settings.reconstruction_workers
        self.retention.policy = Policy(settings.retention_days, settings.retention_bytes, settings.deleted_days)

    def check_catalogue(self) -> tuple[Verdict, str]:
        """Whether the catalogue can be written."""
        with self.catalogue.transaction() as connection:
            connection.execute("UPDATE captures SET document = document WHERE id = ''")
        if not self._recovered:
            return Verdict.WARNING, "recordings that were interrupted are still being made whole"
        return Verdict.OK, ""

    def check_disk(self) -> tuple[Verdict, str]:
        """Whether there is room for captures."""
        space = self.folder.space()
        scarce = min(_SCARCE_BYTES, space.total_bytes // 10)
        if space.free_bytes >= scarce:
            return Verdict.OK, ""
        return Verdict.WARNING, f"{space.free_bytes >> 20} MiB are free at {self.folder.path}: make room there"

    def close(self) -> None:
        """End every worker within a moment, and let go of the folder."""
        self._over.set()
        self.captures.close()
        self._cleaner.join()
        self.catalogue.close()
        self.folder.close()

    def _clean(self) -> None:
        """Recordings of an interrupted service are made whole first: jobs may wait for them."""
        self._guarded(self.captures.recover)
        self._recovered = True
        self._guarded(self.reconstructions.start)
        while not self._over.wait(_CLEAN_S):
            self._guarded(self.captures.retry_saving)
            self._guarded(self.reconstructions.retry_saving)
            self._guarded(self.retention.apply)

    def _guarded(self, work: Callable[[], None]) -> None:
        try:
            work()
        except (SpikedError, OSError) as error:
            self._announce.log("error", f"cleaning up failed, and will be tried again: {error}")
