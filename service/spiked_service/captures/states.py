"""The states of a capture and the events that change them.

Live captures begin as `starting`; uploads and recovered recordings begin as `complete` or `failed`.
"""

from collections.abc import Mapping
from enum import StrEnum

from spiked.ring import DeviceState
from spiked_service.store.rows import CaptureState, Counters


class CaptureEvent(StrEnum):
    """What changes the state of a capture."""

    DEVICE_READY = "device ready"
    """The device is there and has sent no frame of this capture."""
    DEVICE_AWAY = "device away"
    """The camera is absent or sends nothing."""
    FRAMES_RECEIVED = "frames received"
    SOURCE_ENDED = "source ended"
    """Its length is reached, it was stopped, or the acquisition failed; the ring is read to its end."""
    FINISHED = "finished"
    """All workers have exited."""
    FAILED = "failed"
    """All workers have exited, and one of them reported an error that ended the capture."""
    SERVICE_ENDED = "service ended"
    """A later start of the service finds the capture unfinished."""


_STARTING, _WAITING, _STREAMING = CaptureState.STARTING, CaptureState.WAITING, CaptureState.STREAMING
_FINISHING, _COMPLETE, _FAILED = CaptureState.FINISHING, CaptureState.COMPLETE, CaptureState.FAILED

TRANSITIONS: Mapping[CaptureState, Mapping[CaptureEvent, CaptureState]] = {
    _STARTING: {
        CaptureEvent.DEVICE_READY: _STARTING,
        CaptureEvent.DEVICE_AWAY: _WAITING,
        CaptureEvent.FRAMES_RECEIVED: _STREAMING,
        CaptureEvent.SOURCE_ENDED: _FINISHING,
        # Without `finishing` if the source could not be opened, or had ended before the capture was attached to it.
        CaptureEvent.FINISHED: _COMPLETE,
        CaptureEvent.FAILED: _FAILED,
        CaptureEvent.SERVICE_ENDED: _FAILED,
    },
    _WAITING: {
        CaptureEvent.DEVICE_READY: _STARTING,
        CaptureEvent.DEVICE_AWAY: _WAITING,
        CaptureEvent.FRAMES_RECEIVED: _STREAMING,
        CaptureEvent.SOURCE_ENDED: _FINISHING,
        CaptureEvent.SERVICE_ENDED: _FAILED,
    },
    _STREAMING: {
        CaptureEvent.DEVICE_AWAY: _WAITING,
        CaptureEvent.FRAMES_RECEIVED: _STREAMING,
        CaptureEvent.SOURCE_ENDED: _FINISHING,
        CaptureEvent.SERVICE_ENDED: _FAILED,
    },
    _FINISHING: {
        CaptureEvent.FINISHED: _COMPLETE,
        CaptureEvent.FAILED: _FAILED,
        CaptureEvent.SERVICE_ENDED: _FAILED,
    },
    _COMPLETE: {},
    _FAILED: {},
}
"""The legal transitions: state, event, next state."""


def next_state(state: CaptureState, event: CaptureEvent) -> CaptureState:
    """The state after an event. Raises AssertionError for an event that cannot occur in this state."""
    assert event in TRANSITIONS[state], f"a capture that is {state} cannot receive the event '{event}'"
    return TRANSITIONS[state][event]


def device_event(counters: Counters, first_frame: int) -> CaptureEvent:
    """The event that the counters of a ring show; `first_frame` is the ring index at which the capture starts."""
    if counters.device in (DeviceState.ABSENT, DeviceState.LOST) and counters.device_reason:
        return CaptureEvent.DEVICE_AWAY
    return CaptureEvent.FRAMES_RECEIVED if counters.next_frame > first_frame else CaptureEvent.DEVICE_READY
