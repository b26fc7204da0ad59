"""The log: one form for all, levels that change while it runs, lines as events."""

import json
import logging
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import structlog
from spiked_service.events.bus import Bus, Topic
from spiked_service.events.logging import configure_logs, logger, set_level
from spiked_service.settings.settings import LogFormat, LogLevel
from websockets.sync.client import connect


@pytest.fixture(autouse=True)
def restored() -> Iterator[None]:
    """The logging of the tests as it was."""
    root = logging.getLogger()
    handlers, level = root.handlers, root.level
    yield
    root.handlers, root.level = handlers, level
    structlog.reset_defaults()


def test_lines_of_ours_and_of_libraries_are_json_with_ids(capsys: pytest.CaptureFixture[str]) -> None:
    configure_logs(LogLevel.INFO, LogFormat.JSON)
    logger("spiked.capture", capture_id="c1").info("recording started", frames=5)
    logging.getLogger("uvicorn.error").warning("odd %s", "request")
    ours, theirs = (json.loads(line) for line in capsys.readouterr().err.splitlines())
    assert ours.pop("at").endswith("Z")
    assert ours == {
        "event": "recording started",
        "level": "info",
        "logger": "spiked.capture",
        "capture_id": "c1",
        "frames": 5,
    }
    assert (theirs["event"], theirs["level"], theirs["logger"]) == ("odd request", "warning", "uvicorn.error")


def test_an_exception_is_in_the_line(capsys: pytest.CaptureFixture[str]) -> None:
    configure_logs(LogLevel.INFO, LogFormat.JSON)
    try:
        raise ValueError("broken")
    except ValueError:
        logger("spiked").exception("failed")
    (line,) = capsys.readouterr().err.splitlines()
    assert "ValueError: broken" in json.loads(line)["exception"]


def test_the_level_changes_while_it_runs(capsys: pytest.CaptureFixture[str]) -> None:
    configure_logs(LogLevel.WARNING, LogFormat.CONSOLE)
    log = logger("spiked")
    log.info("unheard")
    set_level(LogLevel.DEBUG)
    log.debug("heard")
    told = capsys.readouterr().err
    assert "unheard" not in told and "heard" in told


def test_lines_of_workers_are_in_the_services_log_with_their_ids(daemon: Callable[..., Any], tmp_path: Path) -> None:
    one = daemon()
    address = one.address.replace("http", "ws")
    with connect(f"{address}api/v1/events?topics=log", compression=None) as events:
        source = "sim:?width=96&height=64"
        capture = one.http.post("captures", json={"source": source, "frames": 64}).json()["id"]
        for message in map(json.loads, events):
            if message["data"].get("role") == "recorder":
                break
    assert message["capture_id"] == capture
    assert message["data"]["event"].startswith("recording closed with 64 frames")
    own = (tmp_path / "data" / "captures" / capture / "logs" / "recorder.log").read_text()
    assert "recording closed with 64 frames" in own


def test_lines_are_events_with_their_ids(capsys: pytest.CaptureFixture[str]) -> None:
    bus = Bus()
    listener = bus.subscribe()
    configure_logs(LogLevel.DEBUG, LogFormat.JSON, bus)
    logger("spiked.job", reconstruction_id="r1", capture_id="c1").warning("restarted", after_s=0.5)
    logging.getLogger("library").error("trouble %d", 3)
    logger("spiked").debug("too small to tell")
    logging.getLogger("asyncio").warning("a socket broke")  # an event of it would break it again
    ours, theirs = listener.take(), listener.take()
    assert ours is not None and theirs is not None
    assert (ours.topic, ours.capture_id, ours.reconstruction_id) == (Topic.LOG, "c1", "r1")
    data = json.loads(ours.json)["data"]
    assert data == {"level": "warning", "event": "restarted", "logger": "spiked.job", "after_s": 0.5}
    assert json.loads(theirs.json)["data"] == {"level": "error", "event": "trouble 3", "logger": "library"}
    assert listener.take() is None
    assert len(capsys.readouterr().err.splitlines()) == 4
