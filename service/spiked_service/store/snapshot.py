"""A capture with its counters and the ids of its reconstructions at one moment."""

from dataclasses import dataclass

from spiked_driver.source_kinds import is_camera

from spiked.ring import DeviceState
from spiked_service.store.rows import CaptureRow, CaptureState, Counters

_SILENT = (DeviceState.ABSENT, DeviceState.ARMED, DeviceState.LOST)


@dataclass(frozen=True)
class CaptureJobs:
    """The reconstructions of a capture, however many there are."""

    ids: tuple[str, ...] = ()
    """Of the newest ones, the oldest of these first."""
    total: int = 0
    """Number of all."""


@dataclass(frozen=True)
class Snapshot:
    """A capture with its live counters and the ids of its reconstructions."""

    row: CaptureRow
    counters: Counters | None
    """Counters now or at the end."""
    jobs: CaptureJobs
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
