"""Ten thousand captures: listed in every order and filtered, by pages, over all of them."""

import random
from collections.abc import Iterator
from pathlib import Path

import pytest
from spiked_service.base.ids import new_id
from spiked_service.store.capture_listing import CaptureFilter, CaptureSort
from spiked_service.store.catalogue import Catalogue, UnknownIdError
from spiked_service.store.rows import CaptureRow, Grade, JobState, ReconstructionRow

from tests.many_captures import BEGAN, GRADES, many


@pytest.fixture(scope="module")
def rows() -> list[CaptureRow]:
    return list(many())


@pytest.fixture(scope="module")
def jobs(rows: list[CaptureRow]) -> dict[str, JobState]:
    """State of the newest reconstruction of some captures."""
    dice = random.Random(8)
    return {row.id: dice.choice(list(JobState)) for row in rows[::3]}


@pytest.fixture(scope="module")
def catalogue(
    rows: list[CaptureRow], jobs: dict[str, JobState], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Catalogue]:
    one = Catalogue(tmp_path_factory.mktemp("many") / "catalogue.sqlite")
    with one.transaction():
        for row in rows:
            one.captures.put(row)
        for capture_id, state in jobs.items():
            for each in (JobState.FAILED, state):
                one.reconstructions.put(ReconstructionRow(new_id(), capture_id, False, each, BEGAN))
    yield one
    one.close()


def listed(catalogue: Catalogue, sort: CaptureSort, descending: bool, **wanted: object) -> list[CaptureRow]:
    found: list[CaptureRow] = []
    cursor = None
    while True:
        page = catalogue.capture_page(1500, cursor, sort, descending, **wanted)  # type: ignore[arg-type]
        found += page.items
        cursor = page.next_cursor
        if cursor is None:
            assert page.total == len(found)
            return found


@pytest.mark.parametrize("descending", [True, False])
@pytest.mark.parametrize("sort", CaptureSort)
def test_each_column_sorts_all_captures_and_pages_lose_none(
    catalogue: Catalogue,
    rows: list[CaptureRow],
    jobs: dict[str, JobState],
    sort: CaptureSort,
    descending: bool,
) -> None:
    def length(row: CaptureRow) -> float:
        return 0.0 if row.recording is None or row.sensor is None else row.recording.frames / row.sensor.frame_rate_hz

    keys = {
        CaptureSort.STARTED: lambda row: row.id,
        CaptureSort.NAME: lambda row: (row.name or row.plan.source).lower(),
        CaptureSort.LENGTH: length,
        CaptureSort.SIZE: lambda row: 0 if row.recording is None else row.recording.bytes,
        CaptureSort.VERDICT: lambda row: GRADES.index(None if row.verdict is None else row.verdict.grade),
        CaptureSort.RECONSTRUCTION: lambda row: str(jobs.get(row.id, "")),
    }
    expected = sorted(rows, key=lambda row: (keys[sort](row), row.id), reverse=descending)
    assert [row.id for row in listed(catalogue, sort, descending)] == [row.id for row in expected]


def test_filters_choose_among_all_captures(catalogue: Catalogue, rows: list[CaptureRow]) -> None:
    wanted: CaptureFilter = {"grade": Grade.BAD, "keep": True, "query": "room 0"}
    found = listed(catalogue, CaptureSort.NAME, False, **wanted)
    expected = [
        row
        for row in rows
        if row.keep and row.verdict is not None and row.verdict.grade is Grade.BAD and "room 0" in row.name
    ]
    assert len(expected) > 5
    assert {row.id for row in found} == {row.id for row in expected}
    assert len(listed(catalogue, CaptureSort.STARTED, True, keep=False)) == sum(not row.keep for row in rows)


def test_a_list_goes_on_while_captures_are_added_and_purged(tmp_path: Path) -> None:
    one = Catalogue(tmp_path / "catalogue.sqlite")
    few = list(many(30))
    for row in few:
        one.captures.put(row)
    first = one.capture_page(10, None, CaptureSort.SIZE)
    for row in many(5):
        one.captures.put(row)
    second = one.capture_page(10, first.next_cursor, CaptureSort.SIZE)
    seen = [row.id for row in (*first.items, *second.items)]
    assert len(set(seen)) == 20, "none comes twice"
    assert second.next_cursor is not None
    one.captures.remove(second.next_cursor)
    with pytest.raises(UnknownIdError, match="list anew"):
        one.capture_page(10, second.next_cursor, CaptureSort.SIZE)
    newest = one.capture_page(10)
    assert newest.next_cursor is not None
    one.captures.remove(newest.next_cursor)
    assert len(one.capture_page(10, newest.next_cursor).items) == 10, "ids sort by time, also those that are gone"
