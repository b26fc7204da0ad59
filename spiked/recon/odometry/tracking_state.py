"""State of the tracker, the reason for it, and the changes so far."""

import re
from dataclasses import dataclass, field
from enum import StrEnum


class State(StrEnum):
    """State of the tracker."""

    BOOT = "boot"
    TRACK = "track"
    DEGRADED = "degraded"
    LOST = "lost"
    RELOC = "reloc"


@dataclass
class TrackingState:
    """Current state with its reason, and the history of both."""

    state: State = State.BOOT
    reason: str = "waiting for the first frames"
    changes: list[tuple[float, State, str]] = field(default_factory=list)
    """(time in frames, state, reason) of each change of state."""

    def set(self, time: float, state: State, reason: str) -> None:
        """Set state and reason; a change is recorded unless only figures of the reason differ."""
        if state is not self.state or _without_figures(reason) != _without_figures(self.reason):
            self.changes.append((time, state, reason))
        self.state, self.reason = state, reason

    def explain(self, reason: str) -> None:
        """Replace the reason without recording a change."""
        self.reason = reason

    def assess(self, time: float, degraded_reason: str | None) -> None:
        """Set the state after a view with a pose: degraded for this reason, or tracking."""
        if degraded_reason is not None:
            self.set(time, State.DEGRADED, degraded_reason)
        elif self.state is not State.TRACK:
            self.set(time, State.TRACK, "enough points agree again")


def _without_figures(reason: str) -> str:
    return re.sub(r"[0-9.]+", "#", reason)
