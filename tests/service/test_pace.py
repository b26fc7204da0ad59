"""The pace of a source: unpaced in a capture, in real time while armed, unless the source states one."""

import pytest
from spiked_service.captures.sources import realtime, unpaced


@pytest.mark.parametrize(
    ("given", "used"),
    [
        ("sim:", "sim:?pace=0"),
        ("replay:a.dat?repeat=2", "replay:a.dat?repeat=2&pace=0"),
        ("replay:a.dat?pace=1", "replay:a.dat?pace=1"),
        ("usb0", "usb0"),
    ],
)
def test_a_source_that_can_block_is_unpaced_unless_a_pace_is_given(given: str, used: str) -> None:
    assert unpaced(given) == used


@pytest.mark.parametrize(
    ("given", "used"),
    [("sim:?pace=0", "sim:"), ("sim:?seed=1&pace=0", "sim:?seed=1"), ("usb0?fov=40", "usb0?fov=40"), ("usb0", "usb0")],
)
def test_an_armed_source_runs_in_real_time(given: str, used: str) -> None:
    assert realtime(given) == used
