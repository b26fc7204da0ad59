"""The next take starts while the last one refines; refinements queue, and say when their turn comes."""

from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from spiked_service.api.bus_notifier import BusNotifier
from spiked_service.captures.archive import DataStore
from spiked_service.daemon import open_data_store
from spiked_service.events.bus import Bus, Message, Topic
from spiked_service.reconstructions.queue_estimates import Front, QueueEstimates
from spiked_service.reconstructions.queue_order import QueueOrder
from spiked_service.settings.reconstruction_options import ReconstructionOptions
from spiked_service.store.catalogue import Catalogue, StoreError
from spiked_service.store.rows import (
    CaptureRow,
    CaptureState,
    JobState,
    Origin,
    Plan,
    ReconstructionRow,
    Recorded,
    Stage,
)
from waiting import until

from spiked.recon.time_left import typical_work_s

from .survival import SENSOR, jobs_of, over

CAMERA = "sim:?width=160&height=100&pace=0"
FRAMES = 512
SHORT = ReconstructionOptions(steps=300)
LONG = ReconstructionOptions(steps=200_000)
BEGAN = datetime(2026, 1, 1, tzinfo=UTC)


@pytest.fixture
def told() -> Bus:
    return Bus()


@pytest.fixture
def data_store(told: Bus, tmp_path: Path) -> Iterator[DataStore]:
    one = open_data_store(tmp_path / "data", BusNotifier(told))
    try:
        yield one
    finally:
        one.close()


def take(data_store: DataStore, options: ReconstructionOptions) -> str:
    return data_store.captures.start(Plan(CAMERA, frames=FRAMES, options=options)).id


def job(data_store: DataStore, capture_id: str) -> ReconstructionRow:
    until(lambda: jobs_of(data_store, capture_id), "its reconstruction has begun")
    return jobs_of(data_store, capture_id)[-1]


def test_the_next_take_starts_while_the_last_refines_and_waits_for_its_turn(data_store: DataStore, told: Bus) -> None:
    heard: list[Message] = []
    told.observe(heard.append)
    first = take(data_store, LONG)
    until(lambda: data_store.captures.get(first).row.state is CaptureState.FINISHING, "the first take is over")
    until(lambda: job(data_store, first).stage is Stage.REFINING, "and refines")
    others = []
    for _ in range(2):
        others.append(take(data_store, SHORT))  # the camera is free
        done = over(data_store, others[-1])
        assert done.row.state is CaptureState.COMPLETE and done.row.warnings == ()
        assert done.row.recording is not None and done.row.recording.frames == FRAMES
    waiting = [job(data_store, other) for other in others]
    assert [(row.state, row.queue_place) for row in waiting] == [(JobState.QUEUED, 1), (JobState.QUEUED, 2)]
    assert job(data_store, first).state is JobState.RUNNING and job(data_store, first).queue_place is None
    listed = data_store.reconstructions.rows.page(state=JobState.QUEUED).items
    assert [row.queue_place for row in listed] == [2, 1]  # newest first
    data_store.captures.stop(first)  # asked again: the refinement ends
    for other in others:
        until(lambda: job(data_store, other).state.over, "its turn has come")  # noqa: B023
        assert job(data_store, other).state is JobState.COMPLETE
        assert job(data_store, other).frames == FRAMES and job(data_store, other).queue_place is None
    begun = [job(data_store, other).started_at for other in others]
    assert None not in begun and begun == sorted(begun)  # type: ignore[type-var]
    places: dict[str, list[Any]] = {row.id: [] for row in waiting}
    for message in heard:
        if message.topic is Topic.JOB and message.reconstruction_id in places:
            places[message.reconstruction_id].append(message.plain()["data"]["queue_place"])
    assert next(place for place in places[waiting[1].id] if place) == 2
    assert 1 in places[waiting[1].id], "it has moved up, and that was told"


def test_one_that_nobody_recorded_does_not_give_way(data_store: DataStore) -> None:
    first = take(data_store, LONG)
    until(lambda: job(data_store, first).stage is Stage.REFINING, "the first refines")
    plan = Plan(CAMERA, frames=FRAMES, options=SHORT, record=False)
    done = over(data_store, data_store.captures.start(plan).id)
    assert jobs_of(data_store, done.id)[0].state is JobState.COMPLETE
    data_store.captures.stop(first)


def row(number: int, state: JobState, **fields: Any) -> ReconstructionRow:
    return ReconstructionRow(f"job{number}", f"capture{number}", False, state, BEGAN, **fields)


def test_times_left_follow_from_those_that_run_and_those_that_are_over(tmp_path: Path) -> None:
    catalogue = Catalogue(tmp_path / "catalogue.sqlite")
    for number, frames in enumerate((1000, 1000, 2000, 500)):
        recording = Recorded(frames, frames * SENSOR.frame_bytes)
        plan = Plan("sim:")
        capture = CaptureRow(f"capture{number}", Origin.LIVE, plan, CaptureState.COMPLETE, BEGAN, sensor=SENSOR)
        catalogue.captures.put(replace(capture, recording=recording))
    estimates = QueueEstimates(catalogue, QueueOrder(catalogue))
    for number in (2, 3):
        catalogue.reconstructions.put(row(number, JobState.QUEUED, priority=number))
    running = row(1, JobState.RUNNING, frames=1000, started_at=datetime.now(UTC))
    assert [(one.id, one.queue_place, one.eta_s) for one in estimates.front([running], 1).rows] == [
        ("job3", 1, None), ("job2", 2, None),
    ]  # fmt: skip
    over_row = row(0, JobState.COMPLETE, frames=1000, started_at=BEGAN, ended_at=BEGAN + timedelta(seconds=40))
    catalogue.reconstructions.put(over_row)
    running = replace(running, eta_s=40.0)
    first, second = estimates.front([running], 1).rows
    work = [
        typical_work_s(SENSOR.width, SENSOR.height, frames, ReconstructionOptions().steps)
        for frames in (1000, 2000, 500)
    ]
    long_s, short_s = 40 * work[1] / work[0], 40 * work[2] / work[0]
    assert short_s < 40 < long_s
    assert first.eta_s == pytest.approx(40 + short_s, abs=1)
    assert second.eta_s == pytest.approx(40 + short_s + long_s, abs=2)
    first, second = estimates.front([running], 2).rows  # two at a time: one begins at once
    assert first.eta_s == pytest.approx(short_s, abs=1) and second.eta_s == pytest.approx(short_s + long_s, abs=2)
    assert [one.id for one in estimates.changed(Front([first, second], 0.0, 1.0))] == ["job3", "job2"]
    assert estimates.changed(Front([replace(first, eta_s=short_s + 1), second], 0.0, 1.0)) == []
    moved = replace(second, queue_place=1)
    told = estimates.changed(Front([moved], 0.0, 1.0))
    assert told[0] == moved and [one.id for one in told] == ["job2", "job3"], "one that left the front is told, too"
    quick = row(3, JobState.QUEUED, priority=3, options=ReconstructionOptions(steps=0))
    catalogue.reconstructions.put(quick)
    first = estimates.front([], 1).rows[0]
    quick_s = 40 * typical_work_s(SENSOR.width, SENSOR.height, 500, 0) / work[0]
    assert first.eta_s == pytest.approx(quick_s, abs=1) and 0 < quick_s < short_s / 2, "no step to take"
    catalogue.close()


def test_an_edit_that_cannot_be_saved_changes_nothing(data_store: DataStore, monkeypatch: pytest.MonkeyPatch) -> None:
    catalogue = data_store.catalogue
    capture = CaptureRow(
        "01a20000-0000-7000-8000-000000000001", Origin.LIVE, Plan(CAMERA), CaptureState.COMPLETE, BEGAN
    )
    catalogue.captures.put(capture)
    ids = [f"01a20000-0000-7000-8000-00000000001{n}" for n in range(2)]
    for each in ids:
        catalogue.reconstructions.put(ReconstructionRow(each, capture.id, False, JobState.QUEUED, BEGAN, held=True))
    rows = data_store.reconstructions.rows

    def full(_: ReconstructionRow) -> None:
        raise StoreError("the disk is full")

    with monkeypatch.context() as broken:
        broken.setattr(catalogue.reconstructions, "put", full)
        for edit in ({"name": "a"}, {"held": False}, {"queue_place": 1}):
            with pytest.raises(StoreError, match="disk is full"):
                rows.change(ids[1], **edit)  # type: ignore[arg-type]
    assert (rows.get(ids[1]).name, rows.get(ids[1]).held, rows.get(ids[1]).queue_place) == ("", True, 2)
    assert rows.change(ids[1], name="b", queue_place=1).name == "b"
    assert [rows.get(each).queue_place for each in ids] == [2, 1]
