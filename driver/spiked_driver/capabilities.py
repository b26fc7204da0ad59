"""What cameras can do, and what nobody publishes of them: that reads "not supported", and no register is invented."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Capability:
    """One thing in which cameras differ."""

    supported: bool
    value: str | float | None = None
    """What it is, where there is one value; never set where it is not supported."""

    def __str__(self) -> str:
        """For people."""
        if not self.supported:
            return "not supported"
        return "yes" if self.value is None else str(self.value)


_UNKNOWN = {
    name: Capability(False)
    for name in (
        "trigger_input",
        "trigger_output",
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
"""Of the SPS10-002. Its line counter tells how many frames are lost."""
PCIE_CAPABILITIES = {
    "resolution": Capability(True, "1000x1000"),
    "frame_rate_hz": Capability(True, 20_000.0),
    "frame_counter": Capability(False),
    **_UNKNOWN,
}
"""Of the M1K40. Its stream counts lines within a frame, not frames."""
