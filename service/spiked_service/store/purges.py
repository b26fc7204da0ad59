"""Purged captures in the catalogue: gone from one transaction on, while their jobs are deleted by parts."""

from spiked_service.store.catalogue import Catalogue
from spiked_service.store.rows import JobState


class Purges:
    """The table `purges`. Rows of jobs of the captures in it exist, but nobody who reads finds them."""

    def __init__(self, catalogue: Catalogue) -> None:
        self._catalogue = catalogue

    def ids(self) -> list[str]:
        """Ids of the captures, the oldest first."""
        return [capture_id for (capture_id,) in self._catalogue.read("SELECT capture_id FROM purges")]

    def begin(self, capture_id: str) -> None:
        """Delete the row of a capture, and have its jobs passed over. Raises StoreError."""
        with self._catalogue.transaction() as connection:
            connection.execute("INSERT OR REPLACE INTO purges VALUES (?)", (capture_id,))
            self._catalogue.captures.remove(capture_id)

    def end(self, capture_id: str) -> None:
        """Nothing is left to be deleted, or the capture is back. Raises StoreError."""
        with self._catalogue.transaction() as connection:
            connection.execute("DELETE FROM purges WHERE capture_id = ?", (capture_id,))

    def some_jobs(self, capture_id: str, limit: int) -> list[str]:
        """Ids of jobs that are left, those that wait first: reading the queue steps over those."""
        query = "SELECT id FROM jobs WHERE capture_id = ?"
        queued = self._catalogue.read(f"{query} AND state = ? LIMIT ?", (capture_id, str(JobState.QUEUED), limit))
        return [row_id for (row_id,) in queued or self._catalogue.read(f"{query} LIMIT ?", (capture_id, limit))]
