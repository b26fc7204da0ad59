"""A capture with its counters and reconstructions at one moment."""

from dataclasses import dataclass

from spiked_driver.source_kinds import is_camera

from spiked.ring import DeviceState
from spiked_service.store.rows import CaptureRow, CaptureState, Counters, ReconstructionRow

_SILENT = (DeviceState.ABSENT, DeviceState.ARMED, DeviceState.LOST)


@dataclass(frozen=True)
class CaptureSummary:
    """A capture with its live counters and the ids of its reconstructions."""

    row: CaptureRow
    counters: Counters | None
    """Counters now or at the end."""
    reconstruction_ids: tuple[str, ...]
    """Oldest first."""
    ring: str | None = None
    """Name of the ring in shared memory, while it can be read."""

    @property
    def id(self) -> str:
        """Id of the capture."""
        return self.row.id

    @property
    def waits_for(self) -> str:
        """Reason of the device for sending no frames; empty while it sends or after the end."""
        if self.row.state is CaptureState.FINISHING or self.row.state.over or self.counters is None:
            return ""
        # A camera that cannot be used is idle, and says why; a file or simulation that is idle is at its end.
        silent = self.counters.device in _SILENT
        silent |= self.counters.device is DeviceState.IDLE and is_camera(self.row.source)
        return self.counters.device_reason if silent else ""

    @property
    def reason(self) -> str:
        """Why it failed, else what it waits for."""
        return self.row.reason or self.waits_for

    def with_jobs(self, jobs: tuple[ReconstructionRow, ...]) -> "Snapshot":
        """The same with its reconstructions, oldest first."""
        return Snapshot(self.row, self.counters, tuple(job.id for job in jobs), self.ring, jobs)


@dataclass(frozen=True)
class Snapshot(CaptureSummary):
    """A capture with its live counters and its reconstructions."""

    reconstructions: tuple[ReconstructionRow, ...] = ()
    """Oldest first."""
