"""All that is known of a capture at one moment."""

from dataclasses import dataclass

from spiked_driver.spec import is_camera

from spiked.ring import DeviceState
from spiked_service.store.rows import CaptureRow, CaptureState, Counters, ReconstructionRow

_SILENT = (DeviceState.ABSENT, DeviceState.ARMED, DeviceState.LOST)


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

    @property
    def waits_for(self) -> str:
        """Why its device sends nothing just now, as the device says it; empty while it does, and when that is over."""
        live = self.row.state in (CaptureState.STARTING, CaptureState.STREAMING)
        if not live or self.counters is None:
            return ""
        # A camera that cannot be used is idle, and says why; a file or simulation that is idle is at its end.
        silent = self.counters.device in _SILENT
        silent |= self.counters.device is DeviceState.IDLE and is_camera(self.row.source)
        return self.counters.device_reason if silent else ""

    @property
    def reason(self) -> str:
        """Why it has failed or is about to; else what it waits for."""
        return self.row.reason or self.waits_for
