"""The interface through which captures and jobs publish changes; implemented by `api.bus_notifier`."""

from typing import Protocol

from spiked_service.events.payloads import PosePayload
from spiked_service.results.published import Published
from spiked_service.store.rows import ReconstructionRow
from spiked_service.store.snapshot import Snapshot
from spiked_service.workers.messages import PreviewTaken


class Notifier(Protocol):
    """Called from any thread, also while locks are held: implementations must not block or call back."""

    def capture(self, snapshot: Snapshot) -> None:
        """A capture has changed, or its counters have."""

    def job(self, row: ReconstructionRow) -> None:
        """A reconstruction has changed."""

    def pose(self, row: ReconstructionRow, pose: PosePayload) -> None:
        """A pose was estimated."""

    def scene(self, row: ReconstructionRow, published: Published) -> None:
        """A version was published."""

    def preview(self, capture_id: str | None, taken: PreviewTaken) -> None:
        """There are newer preview images."""

    def log(self, level: str, event: str, capture_id: str | None = None, reconstruction_id: str | None = None) -> None:
        """Write a line to the log."""
