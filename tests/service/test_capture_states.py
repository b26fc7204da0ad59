"""The states of a capture: the table in the documentation is the one that the code follows."""

import re
from pathlib import Path

import pytest
from spiked_service.captures.states import TRANSITIONS, CaptureEvent, device_event, next_state
from spiked_service.store.rows import CaptureState, Counters

from spiked.ring import DeviceState

ARCHITECTURE = Path(__file__).parents[2] / "docs" / "architecture.md"


def documented() -> dict[tuple[str, str], str]:
    """Next states in the table of the documentation, by state and event."""
    text = ARCHITECTURE.read_text()
    rows = [
        [cell.strip(" `") for cell in line.strip("|\n").split("|")]
        for line in re.findall(r"(?m)^\| (?:state \\ event|`\w+`) .*$", text)
    ]
    _, *events = next(row for row in rows if row[0].startswith("state"))
    states = [row for row in rows if len(row) == len(events) + 1 and not row[0].startswith("state")]
    return {(state, event): cell for state, *cells in states for event, cell in zip(events, cells, strict=True) if cell}


def test_the_documented_table_is_the_one_in_the_code() -> None:
    table = {(str(state), str(event)): str(after) for state, row in TRANSITIONS.items() for event, after in row.items()}
    assert documented() == table


def test_every_state_is_reached_and_only_ended_captures_stay() -> None:
    reached, found = set(), {CaptureState.STARTING}
    while found - reached:
        state = (found - reached).pop()
        reached.add(state)
        found |= set(TRANSITIONS[state].values())
    assert reached == set(CaptureState) == set(TRANSITIONS)
    assert {state for state, row in TRANSITIONS.items() if not row} == {state for state in CaptureState if state.over}
    assert all(row[CaptureEvent.SERVICE_ENDED] is CaptureState.FAILED for row in TRANSITIONS.values() if row)


def test_an_event_that_cannot_occur_is_refused() -> None:
    with pytest.raises(AssertionError, match="a capture that is complete cannot receive the event 'source ended'"):
        next_state(CaptureState.COMPLETE, CaptureEvent.SOURCE_ENDED)


@pytest.mark.parametrize(
    ("device", "reason", "frames", "event"),
    [
        (DeviceState.ARMED, "", 0, CaptureEvent.DEVICE_READY),
        (DeviceState.STREAMING, "", 10, CaptureEvent.FRAMES_RECEIVED),
        (DeviceState.STREAMING, "", 5, CaptureEvent.DEVICE_READY),
        (DeviceState.ABSENT, "the camera usb0 is not there", 0, CaptureEvent.DEVICE_AWAY),
        (DeviceState.LOST, "it sends nothing", 10, CaptureEvent.DEVICE_AWAY),
        (DeviceState.ABSENT, "", 0, CaptureEvent.DEVICE_READY),
    ],
)
def test_the_counters_of_the_ring_say_what_the_device_does(
    device: DeviceState, reason: str, frames: int, event: CaptureEvent
) -> None:
    counters = Counters(device, reason, received=frames, lost={}, next_frame=frames, consumers=())
    assert device_event(counters, first_frame=5) is event
