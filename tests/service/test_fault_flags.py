"""Faults injected by flags of the command line."""

import time
from collections.abc import Callable
from typing import Any

import pytest
from spiked_driver import FaultySource
from spiked_driver.spec import open_source
from spiked_service.cli.fault_flags import with_faults

from spiked.errors import ConfigurationError


def test_flags_are_the_sources_options() -> None:
    flagged = with_faults(
        ["sim:", "sim:?seed=4"], drop=0.1, gap=["5:3", "10:0.1ms:ring"], corrupt=0.2, unplug_at=["20:5"], stall=["30:1"]
    )
    written = "drop=0.1&gap=5:3&gap=10:0.1ms:ring&corrupt=0.2&unplug-at=20:5&stall=30:1"
    assert flagged == [f"sim:?{written}", f"sim:?seed=4&{written}"]
    one, two = open_source(flagged[0]), open_source(flagged[1])
    assert isinstance(one, FaultySource)
    assert isinstance(two, FaultySource)
    assert one.faults == two.faults
    assert len(one.faults.losses) == 3


def test_no_flags_change_nothing() -> None:
    assert with_faults(["usb0", "sim:"]) == ["usb0", "sim:"]


@pytest.mark.parametrize(
    ("sources", "message"),
    [([], "--drop, --stall: give the source"), (["sim:", "usb0"], r"not into usb0")],
)
def test_trouble_needs_a_source_that_can_have_it(sources: list[str], message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        with_faults(sources, drop=0.1, stall=["3:1"])


def test_a_daemon_rehearses_trouble(daemon: Callable[..., Any]) -> None:
    rehearsal = ["--gap", "100:40", "--unplug-at", "400:10ms", "--corrupt", "0.01"]
    http = daemon("--device", "sim:?width=64&height=48", "--frames", "1200", *rehearsal).http
    deadline_s = time.monotonic() + 60
    while not (counters := http.get("captures").json()["items"][0]["counters"]) or counters["next_frame"] < 600:
        assert time.monotonic() < deadline_s, counters
        time.sleep(0.1)
    assert counters["lost"] == {"device": 200, "usb": 40, "ring": 0, "disk": 0}
    assert counters["received"] + 240 == counters["next_frame"]
