"""States of a connection to a camera, and the table of its legal transitions."""

from collections.abc import Mapping
from enum import StrEnum

from spiked.ring import DeviceState, DeviceStatus


class ConnectionState(StrEnum):
    """State of the connection to a camera."""

    CLOSED = "closed"
    SEARCHING = "searching"
    """No camera is open."""
    ARMED = "armed"
    """Reads are queued; no frame was delivered since."""
    STREAMING = "streaming"
    FRAMELESS = "frameless"
    """Reads complete, but their bytes hold no frame."""
    DRAINING = "draining"
    """Reads are cancelled; what completed before is still taken."""


_CLOSE = {ConnectionState.CLOSED: "the source is closed"}
_FRAME = {ConnectionState.STREAMING: "a frame is delivered"}
_NO_FRAME = {ConnectionState.FRAMELESS: "bytes without a frame for 1 s"}
_FAILURE = {ConnectionState.DRAINING: "a transfer fails, or no byte for `silence_s`"}

TRANSITIONS: Mapping[ConnectionState, Mapping[ConnectionState, str]] = {
    ConnectionState.CLOSED: {ConnectionState.SEARCHING: "the source is opened"},
    ConnectionState.SEARCHING: {ConnectionState.ARMED: "the camera is open and its reads are queued", **_CLOSE},
    ConnectionState.ARMED: {**_FRAME, **_NO_FRAME, **_FAILURE, **_CLOSE},
    ConnectionState.STREAMING: {**_NO_FRAME, **_FAILURE, **_CLOSE},
    ConnectionState.FRAMELESS: {**_FRAME, **_FAILURE, **_CLOSE},
    ConnectionState.DRAINING: {
        ConnectionState.ARMED: "all is taken, and the reads are queued again in the same session",
        ConnectionState.SEARCHING: "all is taken and the session closed, or a cancelled read does not end in 0.4 s",
        **_CLOSE,
    },
}
"""For each state, those that may follow, with the condition. docs/usb.md shows this table."""

DEVICE_STATES: Mapping[ConnectionState, tuple[DeviceState, ...]] = {
    ConnectionState.CLOSED: (DeviceState.IDLE,),
    ConnectionState.SEARCHING: (DeviceState.ABSENT, DeviceState.IDLE, DeviceState.LOST),
    ConnectionState.ARMED: (DeviceState.ARMED,),
    ConnectionState.STREAMING: (DeviceState.STREAMING,),
    ConnectionState.FRAMELESS: (DeviceState.LOST,),
    ConnectionState.DRAINING: (DeviceState.LOST,),
}
"""For each state, what a capture reports as its device's. While searching: absent; idle if the camera is there and
cannot be used (port, permission); lost if it has just been lost or does not answer."""


class ConnectionStateMachine:
    """A connection's state and the device status reported with it. Starts closed."""

    def __init__(self) -> None:
        self.state = ConnectionState.CLOSED
        self.device_status = DeviceStatus(DeviceState.IDLE)

    def enter(self, state: ConnectionState, status: DeviceStatus) -> None:
        """Change the state. Raises ValueError for a transition that the table does not have."""
        if state not in TRANSITIONS[self.state]:
            raise ValueError(f"a connection cannot change from {self.state} to {state}")
        self.state = state
        self.report(status)

    def report(self, status: DeviceStatus) -> None:
        """Change the device status. Raises ValueError for one that does not go with the state."""
        if status.state not in DEVICE_STATES[self.state]:
            raise ValueError(f"a connection that is {self.state} cannot report its device as {status.state}")
        self.device_status = status
