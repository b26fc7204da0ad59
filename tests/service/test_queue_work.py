"""What is done for a request does not grow with the number of jobs: steps of SQLite's machine, rows read, messages."""

import sqlite3
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pytest
from spiked_service.api.bus_notifier import BusNotifier
from spiked_service.api.idempotency import IdempotencyKeys
from spiked_service.daemon import open_data_store
from spiked_service.events.bus import Bus, Topic
from spiked_service.reconstructions.queue_order import QueueOrder
from spiked_service.reconstructions.queue_policy import QueuePolicy
from spiked_service.reconstructions.repository import LISTED, ReconstructionRepository
from spiked_service.store import catalogue as catalogue_module
from spiked_service.store.capture_listing import CaptureSort
from spiked_service.store.catalogue import Catalogue
from spiked_service.store.folder import DataFolder
from spiked_service.store.rows import (
    CaptureRow,
    CaptureState,
    JobState,
    Origin,
    Plan,
    ReconstructionRow,
    Recorded,
)
from waiting import until

from .survival import SENSOR

FEW, MANY = 500, 10_000
BEGAN = datetime(2026, 1, 1, tzinfo=UTC)
STATES = (JobState.QUEUED, JobState.COMPLETE, JobState.QUEUED, JobState.FAILED, JobState.CANCELLED)
CAPTURE = "01a20000-0000-7000-9000-000000000000"
OTHER = "01a20000-0000-7000-9000-000000000001"


def job_id(number: int) -> str:
    """As if one were made every 50 ms."""
    digits = f"{0x01A2_0000_0000 + 50 * number:012x}"
    return f"{digits[:8]}-{digits[8:]}-7000-8000-{number:012x}"


def capture(capture_id: str, recorded: bool = True) -> CaptureRow:
    recording = Recorded(256, 256 * SENSOR.frame_bytes) if recorded else None
    state = CaptureState.COMPLETE if recorded else CaptureState.STREAMING
    return CaptureRow(capture_id, Origin.LIVE, Plan("sim:"), state, BEGAN, sensor=SENSOR, recording=recording)


def job(number: int, capture_id: str = CAPTURE, state: JobState = JobState.QUEUED) -> ReconstructionRow:
    row = ReconstructionRow(job_id(number), capture_id, False, state, BEGAN, priority=number % 3)
    return row if state is JobState.QUEUED else replace(row, started_at=BEGAN, ended_at=BEGAN, version=1)


class House:
    """A catalogue with jobs, nearly all of one capture, and what reads and writes it; its work is counted."""

    def __init__(self, folder: Path, jobs: int, monkeypatch: pytest.MonkeyPatch) -> None:
        self.connections: list[sqlite3.Connection] = []
        connect = catalogue_module._connect

        def kept(path: Path) -> sqlite3.Connection:
            self.connections.append(connect(path))
            return self.connections[-1]

        monkeypatch.setattr(catalogue_module, "_connect", kept)
        self.folder = DataFolder(folder)
        self.catalogue = Catalogue(self.folder.catalogue)
        with self.catalogue.transaction():
            for one in (CAPTURE, OTHER):
                self.catalogue.captures.put(capture(one))
            for number in range(jobs):
                self.catalogue.reconstructions.put(
                    job(number, OTHER if number % 100 == 0 else CAPTURE, STATES[number % 5])
                )
        self.bus = Bus()
        self.rows = ReconstructionRepository(self.folder, self.catalogue, BusNotifier(self.bus), QueuePolicy())
        self.queued = [number for number in range(jobs) if STATES[number % 5] is JobState.QUEUED]
        self.jobs = jobs

    def steps(self, work: Callable[[], object]) -> int:
        """Tens of steps of SQLite's virtual machine."""
        counted = 0

        def count() -> int:
            nonlocal counted
            counted += 1
            return 0

        with self.catalogue._reader():  # so that there is one
            pass
        for one in self.connections:
            one.set_progress_handler(count, 10)
        work()
        for one in self.connections:
            one.set_progress_handler(None, 0)
        return counted

    def close(self) -> None:
        self.rows.close()
        self.catalogue.close()
        self.folder.close()

    def requests(self) -> dict[str, Callable[[], object]]:
        """What the routes do."""
        rows, catalogue = self.rows, self.catalogue
        first, middle, last = (job_id(self.queued[len(self.queued) * at // 100]) for at in (0, 50, 99))
        new = iter(range(self.jobs, self.jobs + 100))
        return {
            "the front": lambda: rows.in_turn(100),
            "the middle of the queue": lambda: rows.in_turn(100, middle),
            "the newest": lambda: rows.page(100),
            "the newest queued": lambda: rows.page(100, state=JobState.QUEUED),
            "the newest of a capture": lambda: rows.page(100, capture_id=CAPTURE),
            "the newest failed of a capture": lambda: rows.page(100, capture_id=CAPTURE, state=JobState.FAILED),
            "the last of the queue": lambda: rows.get(last),
            "the first of the queue": lambda: rows.get(first),
            "numbers for the metrics": lambda: (rows.counts(), catalogue.capture_counts(), catalogue.grade_counts()),
            "jobs of a capture": lambda: rows.jobs_of(CAPTURE),
            "the scene of a capture": lambda: rows.shown_of([CAPTURE]),
            **{f"captures by {one}": lambda one=one: catalogue.capture_page(100, sort=one) for one in CaptureSort},
            "a new one": lambda: rows.add(job(next(new))),
            "a name": lambda: rows.change(last, name="sharp"),
            "to the front": lambda: rows.change(last, queue_place=3),
            "to the middle": lambda: rows.change(first, queue_place=len(self.queued) // 2),
            "held": lambda: rows.change(middle, held=True),
            "the next to begin": lambda: next(rows.queued()),
            "cancelled": lambda: rows.save(replace(rows.get(last), state=JobState.CANCELLED)),
            "removed": lambda: rows.remove(job_id(3)),
        }


@pytest.fixture
def house(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[int], House]]:
    made: list[House] = []

    def make(jobs: int) -> House:
        made.append(House(tmp_path / f"{jobs}", jobs, monkeypatch))
        return made[-1]

    yield make
    for one in made:
        one.close()


def test_the_work_of_a_request_does_not_grow_with_the_jobs(house: Callable[[int], House]) -> None:
    small, large = house(FEW), house(MANY)
    worst = {}
    for (name, few), many in zip(small.requests().items(), large.requests().values(), strict=True):
        worst[name] = (small.steps(few), large.steps(many))
    assert {name: counts for name, counts in worst.items() if counts[1] > 2 * counts[0] + 100} == {}


def test_no_request_scans_a_table_or_sorts(house: Callable[[int], House], monkeypatch: pytest.MonkeyPatch) -> None:
    one = house(FEW)
    asked: set[str] = set()
    read = one.catalogue.read

    def noted(query: str, values: tuple[object, ...] = ()) -> list[tuple[object, ...]]:
        asked.add(query)
        return read(query, values)

    monkeypatch.setattr(one.catalogue, "read", noted)
    requests = one.requests()
    for ask in requests.values():
        ask()
    assert len(asked) > 15
    plans = {
        query: [str(row[-1]) for row in read(f"EXPLAIN QUERY PLAN {query}", ("",) * query.count("?"))]
        for query in asked
    }
    few = ("SCAN capture_counts", "SCAN (subquery-1)", "SCAN purges", "SCAN CONSTANT ROW")
    slow = {
        query: plan
        for query, plan in plans.items()
        if any("B-TREE FOR ORDER" in line for line in plan)
        or ("LIMIT" not in query and any(line.startswith("SCAN") and line not in few for line in plan))
    }
    assert slow == {}


def test_old_idempotency_keys_are_found_by_an_index(house: Callable[[int], House]) -> None:
    one = house(1)
    IdempotencyKeys(one.catalogue)
    plan = one.catalogue.read("EXPLAIN QUERY PLAN DELETE FROM idempotency WHERE at < ''")
    assert "idempotency_by_age" in str(plan)


def test_a_capture_with_many_jobs_lists_the_newest(house: Callable[[int], House]) -> None:
    one = house(FEW)
    ids = [job_id(number) for number in range(FEW) if number % 100]
    jobs = one.rows.jobs_of(CAPTURE)
    assert jobs.ids == tuple(ids[-LISTED:]) and jobs.total == len(ids) > LISTED
    few = one.rows.jobs_of(OTHER)
    assert few.ids == tuple(job_id(number) for number in range(0, FEW, 100)) and few.total == len(few.ids)


def test_jobs_that_wait_for_a_recording_are_passed_over_at_once(
    house: Callable[[int], House], monkeypatch: pytest.MonkeyPatch
) -> None:
    one = house(MANY)
    order, read = QueueOrder(one.catalogue), 0
    parse = one.catalogue.reconstructions.parse

    def counted(document: str | bytes) -> ReconstructionRow:
        nonlocal read
        read += 1
        return parse(document)

    monkeypatch.setattr(one.catalogue.reconstructions, "parse", counted)
    passed = set[str]()
    for row in order.released(passed):
        passed.add(row.capture_id)
    assert passed == {CAPTURE, OTHER} and read < 100


def test_many_changes_at_the_front_are_told_together(house: Callable[[int], House]) -> None:
    one = house(FEW)
    front = [row.id for row in one.rows.in_turn(100).items]
    with one.rows._lock:  # so that nothing is told in between
        for place, moved in enumerate(front[50:0:-1], 1):
            one.rows.change(moved, queue_place=place)
    until(lambda: one.bus.published()[Topic.JOB] >= 100, "the places of all are told")
    assert one.bus.published()[Topic.JOB] <= 50 + 2 * 100


def test_jobs_of_a_removed_capture_never_begin_and_are_cancelled(tmp_path: Path) -> None:
    data_store = open_data_store(tmp_path / "data", BusNotifier(Bus()))
    try:
        catalogue = data_store.catalogue
        until(lambda: "queue" in {thread.name for thread in threading.enumerate()}, "the queue runs")
        with catalogue.transaction():
            catalogue.captures.put(capture(CAPTURE))
            for number in range(FEW):
                catalogue.reconstructions.put(replace(job(number), held=number % 2 == 0))
        with data_store.reconstructions._lock:
            data_store.captures.removal.remove(CAPTURE)
            assert 0 < catalogue.job_counts(CAPTURE)[JobState.CANCELLED] < 50, "the request does not wait for all"
        until(lambda: catalogue.job_counts(CAPTURE)[JobState.CANCELLED] == FEW, "all are cancelled")
        assert {row.attempts for row in catalogue.reconstructions.where()} == {0}
    finally:
        data_store.close()


def test_those_that_were_left_waiting_are_cancelled_at_the_next_start(tmp_path: Path) -> None:
    folder = DataFolder(tmp_path / "data")
    catalogue = Catalogue(folder.catalogue, folder)
    with catalogue.transaction():
        catalogue.captures.put(replace(capture(CAPTURE), deleted_at=datetime.now(UTC)))
        for number in range(50):
            catalogue.reconstructions.put(replace(job(number), held=True))
    catalogue.close()
    folder.close()
    data_store = open_data_store(tmp_path / "data", BusNotifier(Bus()))
    until(lambda: data_store.catalogue.job_counts(CAPTURE)[JobState.CANCELLED] == 50, "all are cancelled")
    data_store.close()
