"""What the parts of the service tell the world of: the one place that knows how, is `api.announce`."""

from typing import Protocol

from spiked_service.messages import PreviewTaken, VersionPublished
from spiked_service.payloads import PosePayload
from spiked_service.snapshot import Snapshot
from spiked_service.store.rows import ReconstructionRow


class Announcer(Protocol):
    """Called from any thread, also while locks are held: it must neither block nor call back."""

    def capture(self, snapshot: Snapshot) -> None:
        """A capture has changed, or its counters have."""

    def job(self, row: ReconstructionRow) -> None:
        """A reconstruction has changed."""

    def pose(self, row: ReconstructionRow, pose: PosePayload) -> None:
        """A block was tracked."""

    def scene(self, row: ReconstructionRow, published: VersionPublished) -> None:
        """A version was published."""

    def preview(self, capture_id: str | None, taken: PreviewTaken) -> None:
        """There are newer pictures."""

    def log(self, level: str, event: str, capture_id: str | None = None, reconstruction_id: str | None = None) -> None:
        """Something a person should know."""
