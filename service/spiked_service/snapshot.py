"""All that is known of a capture at one moment."""

from dataclasses import dataclass

from spiked_service.store.rows import CaptureRow, Counters, ReconstructionRow


@dataclass(frozen=True)
class Snapshot:
    """A capture with its live counters and its reconstructions."""

    row: CaptureRow
    counters: Counters | None
    """Now, or as they were at the end."""
    reconstructions: tuple[ReconstructionRow, ...]
    """Oldest first."""

    @property
    def id(self) -> str:
        """Of the capture."""
        return self.row.id
