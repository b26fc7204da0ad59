"""Maintenance of the data folder while the service runs."""

import threading
from collections.abc import Callable

from spiked.errors import SpikedError
from spiked_service.base.health import CheckStatus
from spiked_service.captures.captures import Captures
from spiked_service.captures.recovery import Recovery
from spiked_service.reconstructions.notifier import Notifier
from spiked_service.reconstructions.queue import Reconstructions
from spiked_service.settings.settings import Settings
from spiked_service.store.catalogue import Catalogue
from spiked_service.store.disk_space import DiskSpace
from spiked_service.store.folder import DataFolder
from spiked_service.store.retention import Policy, Retention

_CLEAN_S = 60.0
"""Interval at which retention is applied, seconds."""
_SCARCE_BYTES = 1 << 30
"""Free space below which a warning is given; a tenth of a small disk."""


class DataStore:
    """Maintains the data folder: recovers it after the start, applies settings and retention, and closes everything."""

    def __init__(
        self,
        folder: DataFolder,
        catalogue: Catalogue,
        disk_space: DiskSpace,
        reconstructions: Reconstructions,
        captures: Captures,
        retention: Retention,
        recovery: Recovery,
        notifier: Notifier,
    ) -> None:
        """Start the maintenance, which also starts the queue of the reconstructions."""
        self.folder = folder
        self.catalogue = catalogue
        self.disk_space = disk_space
        self.reconstructions = reconstructions
        self.captures = captures
        self.retention = retention
        self._recovery = recovery
        self._notifier = notifier
        self._recovered = False
        self._over = threading.Event()
        self._cleaner = threading.Thread(target=self._clean, name="retention", daemon=True)
        self._cleaner.start()

    def configure(self, settings: Settings) -> None:
        """Apply limits and retention, at the start and when the settings change."""
        self.captures.limit = settings.limit_captures
        self.reconstructions.policy.limit = settings.reconstruction_workers
        self.retention.policy = Policy(settings.retention_days, settings.retention_bytes, settings.deleted_days)

    def check_catalogue(self) -> tuple[CheckStatus, str]:
        """Whether the catalogue can be written."""
        with self.catalogue.transaction() as connection:
            connection.execute("UPDATE captures SET document = document WHERE id = ''")
        if not self._recovered:
            return CheckStatus.WARNING, "recovery of interrupted captures is still running"
        return CheckStatus.OK, ""

    def check_disk(self) -> tuple[CheckStatus, str]:
        """Whether there is disk space for captures."""
        space = self.folder.space()
        if self.disk_space.storable_bytes < self.disk_space.least_bytes:
            free = f"{space.free_bytes >> 20} MiB are free at {self.folder.path}"
            return CheckStatus.FAILED, f"{free}, too little to store a capture: free disk space there"
        scarce = min(_SCARCE_BYTES, space.total_bytes // 10)
        if space.free_bytes >= scarce:
            return CheckStatus.OK, ""
        return (
            CheckStatus.WARNING,
            f"{space.free_bytes >> 20} MiB are free at {self.folder.path}: free disk space there",
        )

    def close(self) -> None:
        """End every worker within about a second and unlock the folder."""
        self._over.set()
        self.captures.close()
        self._cleaner.join()
        self.captures.purging.close()
        self.catalogue.close()
        self.folder.close()

    def _clean(self) -> None:
        """Recover interrupted recordings, start the queue, then apply retention every `_CLEAN_S`."""
        self._guarded(lambda: self._recovery.run(self._over.is_set))
        self.captures.purging.start()
        self._guarded(self.reconstructions.start)
        self._guarded(lambda: self._recovery.check_results(self._over.is_set))
        self._recovered = True
        while not self._over.wait(_CLEAN_S):
            self._guarded(self.captures.retry_saving)
            self._guarded(self.reconstructions.rows.retry_saving)
            self.reconstructions.wake_queue()  # jobs may have waited for a row
            self._guarded(self.retention.apply)
            self.catalogue.keep_reserve()

    def _guarded(self, work: Callable[[], None]) -> None:
        try:
            work()
        except (SpikedError, OSError) as error:
            self._notifier.log("error", f"maintenance of the data folder failed and will be retried: {error}")
