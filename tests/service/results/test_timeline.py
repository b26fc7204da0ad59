"""The timeline of a reconstruction: parts of it, coarser ones, and one that grows while it is read."""

import json
from pathlib import Path

import numpy as np
import pytest
from spiked_service.results.timeline import STATES, Timeline, Timelines
from spiked_service.results.timeline_writer import NAME, TimelineWriter

from spiked.errors import SceneError
from spiked.recon import State


def line(frame: int, state: str = "track", **more: object) -> str:
    return json.dumps({"time_s": frame / 20_000, "frame": frame, "state": state, "chi2": 1.0, **more}) + "\n"


def gap(first: int, count: int, cause: str = "usb") -> str:
    return json.dumps({"gap": {"first": first, "count": count, "cause": cause}}) + "\n"


def test_a_short_loss_and_every_lost_frame_show_at_any_scale(tmp_path: Path) -> None:
    path = tmp_path / "timeline.jsonl"
    lines = [line(32 * i, "lost" if i == 517 else "track", loss=None if i % 2 else 0.25) for i in range(40_000)]
    path.write_text("".join(lines) + "".join(gap(100 * i, 3) for i in range(5000)))
    coarse = Timeline.read(path).reduced(300)
    assert 290 < len(coarse.moments) <= 300 and 290 < len(coarse.gaps) <= 300
    assert [STATES[one] for one in coarse.moments["state"]].count(State.LOST) == 1
    assert sum(one.count for one in coarse.gaps) == 15_000
    assert coarse.moments["loss"] == pytest.approx(0.25) and coarse.moments["frame"][-1] == 32 * 39_999
    part = Timeline.read(path).between(1.0, 1.5)
    assert (part.moments["time_s"].min(), part.moments["time_s"].max()) == (1.0, pytest.approx(1.4992))
    assert (part.gaps[0].first, part.gaps[-1].first) == (20_000, 29_900)
    assert len(part.reduced(10_000).moments) == len(part.moments) == 313


def test_what_is_added_is_read_and_a_new_timeline_takes_its_place(tmp_path: Path) -> None:
    path, timelines = tmp_path / "timeline.jsonl", Timelines()
    assert len(timelines.read(path).moments) == 0
    with path.open("w") as file:
        for count in range(1, 40):
            file.write(line(32 * count) + ('{"time_s": 1, "fra' if count == 39 else ""))
            file.flush()
            assert len(timelines.read(path).moments) == count
    with path.open("a") as file:
        file.write('me": 2000, "state": "track"}\n{"time_s": 1, "state": "none"}\nnoise\n')
        file.write('{"closure": {"earlier_s": 0.1, "later_s": 3.5}}\n')
    assert timelines.read(path).moments["frame"][-1] == 2000
    assert [(one.earlier_s, one.later_s) for one in timelines.read(path).closures] == [(0.1, 3.5)]
    path.write_text("".join(line(16 * i, "boot") for i in range(200)))
    again = timelines.read(path)
    assert len(again.moments) == 200 and not again.closures
    path.write_text(line(5))
    np.testing.assert_array_equal(timelines.read(path).moments["frame"], [5])


def test_closed_loops_are_told_once_also_after_a_resumption(tmp_path: Path) -> None:
    path = tmp_path / "timeline.jsonl"
    path.write_text(line(16) + '{"closure": {"earlier_s": 0.1, "later_s": 3.5}}\n' + gap(20, 4) + line(32))
    writer = TimelineWriter(tmp_path, views=2, frames=40)
    assert writer.moments == 2
    for closures in ([(0.1, 3.5)], [(0.1, 3.5), (0.2, 3.6)]):
        writer.closed(closures)
    timeline = Timeline.read(path)
    assert [(one.earlier_s, one.later_s) for one in timeline.closures] == [(0.1, 3.5), (0.2, 3.6)]
    assert len(timeline.moments) == 2 and len(timeline.gaps) == 1


def test_a_timeline_on_a_full_disk_says_what_to_do(tmp_path: Path) -> None:
    (tmp_path / NAME).symlink_to("/dev/full")
    writer = TimelineWriter(tmp_path)
    with pytest.raises(SceneError, match="timeline cannot be written: No space left on device; free disk space"):
        writer.lost(0, 3, "usb")
