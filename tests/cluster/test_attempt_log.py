"""The log of a job with several attempts."""

from pathlib import Path

import pytest
from spiked_service.cluster import attempt_log
from spiked_service.cluster.attempt_log import AttemptLog


def said(log: AttemptLog, text: str) -> None:
    log.arriving.write_text(text)
    log.take()


def test_each_attempt_adds_what_it_says(tmp_path: Path) -> None:
    path = tmp_path / "log"
    first = AttemptLog(path, "1")
    first.begin("here")
    said(first, "reading")
    said(first, "reading\nno light")
    first.end("the worker was killed")
    never_begun = AttemptLog(path, "2")
    never_begun.end("the engine has ended")
    third = AttemptLog(path, "3")
    third.begin("there\n== forged")
    said(third, "reading\n")
    expected = (
        "== attempt 1 on here ==\nreading\nno light\n== attempt 1 has ended: the worker was killed ==\n"
        "== attempt 3 on there == forged ==\nreading\n"
    )
    assert path.read_text() == expected
    after_a_restart = AttemptLog(path, "3")
    said(after_a_restart, "reading\ntracking\n")
    assert path.read_text() == expected + "tracking\n"
    after_a_restart.end("its machine does not answer any more")
    assert path.read_text().endswith("tracking\n== attempt 3 has ended: its machine does not answer any more ==\n")
    assert list(tmp_path.iterdir()) == [path]


def test_old_lines_make_room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(attempt_log, "_MOST_BYTES", 200)
    path = tmp_path / "log"
    for attempt in range(20):
        log = AttemptLog(path, f"{attempt}")
        log.begin("here")
        said(log, "".join(f"line {number}\n" for number in range(100)))
        log.end("killed")
        assert path.stat().st_size < 2 * 200 + 200
    lines = path.read_text().splitlines()
    assert lines[0] == "(earlier lines were removed)"
    assert lines[-2:] == ["line 99", "== attempt 19 has ended: killed =="]
    assert "== attempt 18 has ended: killed ==" in lines and "== attempt 19 on here ==" in lines
    assert all(line.startswith(("line ", "== ", "(")) for line in lines), "no line is cut"
