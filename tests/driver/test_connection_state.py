"""The table of a USB connection's states: complete, documented, and enforced."""

from itertools import product
from pathlib import Path

import pytest
from spiked_driver.connection_state import DEVICE_STATES, TRANSITIONS, ConnectionState, ConnectionStateMachine

from spiked.ring import DeviceState, DeviceStatus

DOCS = Path(__file__).parents[2] / "docs" / "usb.md"


def machine_in(state: ConnectionState) -> ConnectionStateMachine:
    """A machine that was led to a state by legal transitions only."""
    paths = {ConnectionState.CLOSED: [ConnectionState.CLOSED]}
    while state not in paths:
        for known in list(paths):
            for following in TRANSITIONS[known]:
                paths.setdefault(following, [*paths[known], following])
    machine = ConnectionStateMachine()
    for step in paths[state][1:]:
        machine.enter(step, DeviceStatus(DEVICE_STATES[step][0]))
    return machine


@pytest.mark.parametrize(("state", "following"), list(product(ConnectionState, repeat=2)))
def test_only_transitions_of_the_table_are_possible(state: ConnectionState, following: ConnectionState) -> None:
    machine = machine_in(state)
    status = DeviceStatus(DEVICE_STATES[following][-1], "why")
    if following in TRANSITIONS[state]:
        machine.enter(following, status)
        assert (machine.state, machine.device_status) == (following, status)
    else:
        with pytest.raises(ValueError, match=f"cannot change from {state} to {following}"):
            machine.enter(following, status)
        assert machine.state is state


@pytest.mark.parametrize("state", ConnectionState)
def test_a_state_reports_only_the_device_states_that_go_with_it(state: ConnectionState) -> None:
    machine = machine_in(state)
    for reported in DEVICE_STATES[state]:
        machine.report(DeviceStatus(reported))
    with pytest.raises(ValueError, match=f"{state} cannot report"):
        machine.report(DeviceStatus(next(one for one in DeviceState if one not in DEVICE_STATES[state])))


def test_every_state_but_closed_can_be_closed() -> None:
    assert {state for state in ConnectionState if ConnectionState.CLOSED in TRANSITIONS[state]} == {
        *ConnectionState
    } - {ConnectionState.CLOSED}


def test_the_documentation_shows_the_table() -> None:
    rows = [
        f"| {state} | {', '.join(DEVICE_STATES[state])} | {following} | {when} |"
        for state, transitions in TRANSITIONS.items()
        for following, when in transitions.items()
        if following is not ConnectionState.CLOSED
    ]
    lines = DOCS.read_text().splitlines()
    assert [row for row in rows if row not in lines] == []
