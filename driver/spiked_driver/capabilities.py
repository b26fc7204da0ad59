"""Capabilities of the cameras. Features that their makers do not document are "not supported"."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Capability:
    """A feature that a camera has or lacks."""

    supported: bool
    value: str | float | None = None
    """Its value, if it has one; None if it is not supported."""

    def __str__(self) -> str:
        """As shown to users."""
        if not self.supported:
            return "not supported"
        return "yes" if self.value is None else str(self.value)


_UNKNOWN = {
    name: Capability(False)
    for name in (
        "trigger_input",
        "trigger_output",
        "ptp",
        "exposure",
        "threshold",
        "gain",
        "region_of_interest",
        "frame_rate_control",
        "hardware_timestamps",
        "network_forwarding",
    )
}
USB_CAPABILITIES = {
    "resolution": Capability(True, "400x250"),
    "frame_rate_hz": Capability(True, 20_000.0),
    "frame_counter": Capability(True),
    **_UNKNOWN,
}
"""SPS10-002. Its line counter shows how many frames are lost."""
PCIE_CAPABILITIES = {
    "resolution": Capability(True, "1000x1000"),
    "frame_rate_hz": Capability(True, 20_000.0),
    "frame_counter": Capability(False),
    **_UNKNOWN,
}
"""M1K40. Its stream numbers lines within a frame, not frames."""
