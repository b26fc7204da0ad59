"""Places, pages and moves of a queue follow what was saved, changed and removed."""

import random
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import pytest
from spiked_service.reconstructions.queue_order import QueueOrder, turn_between
from spiked_service.store.catalogue import Catalogue, UnknownIdError
from spiked_service.store.rows import JobState, ReconstructionRow

BEGAN = datetime(2026, 1, 1, tzinfo=UTC)


@pytest.fixture
def catalogue(tmp_path: Path) -> Iterator[Catalogue]:
    one = Catalogue(tmp_path / "catalogue.sqlite")
    yield one
    one.close()


def add(catalogue: Catalogue, number: int, priority: int = 0) -> str:
    row_id = f"01a20000-0000-7000-8000-{number:012d}"
    catalogue.reconstructions.put(
        ReconstructionRow(row_id, "capture", False, JobState.QUEUED, BEGAN, priority=priority)
    )
    return row_id


def ids(order: QueueOrder) -> list[str]:
    return [row.id for row in order.first(1000)]


def test_any_moves_give_the_order_of_a_list(catalogue: Catalogue) -> None:
    order, dice = QueueOrder(catalogue), random.Random(5)
    wanted = [add(catalogue, number, 3 - number // 10) for number in range(30)]
    for _ in range(300):
        moved, place = dice.choice(wanted), dice.choice((1, 2, 30, 99, dice.randrange(1, 31)))
        before = [catalogue.reconstructions.get(one) for one in wanted]
        row = order.moved(catalogue.reconstructions.get(moved), place)
        assert row.priority == before[min(place, 30) - 1].priority
        catalogue.reconstructions.put(row)
        wanted.remove(moved)
        wanted.insert(place - 1, moved)
        assert ids(order) == wanted
    assert order.places(wanted[::3]) == {one: place for place, one in enumerate(wanted, 1) if place % 3 == 1}


def test_what_leaves_the_queue_has_no_place(catalogue: Catalogue) -> None:
    order = QueueOrder(catalogue)
    a, b, c, d = (add(catalogue, number) for number in range(4))
    catalogue.reconstructions.set(a, state=JobState.RUNNING)
    catalogue.reconstructions.remove(c)
    catalogue.reconstructions.set(b, held=True)
    assert ids(order) == [b, d] and len(order) == 2
    assert order.places([a, b, c, d]) == {b: 1, d: 2}
    assert [row.id for row in order.released()] == [d]
    catalogue.reconstructions.set(a, state=JobState.QUEUED)
    assert ids(order) == [a, b, d]


def test_pages_go_on_where_a_job_was_that_has_begun(catalogue: Catalogue) -> None:
    order = QueueOrder(catalogue)
    made = [add(catalogue, number) for number in range(50)]
    page = order.page(10, None)
    assert ([row.id for row in page.items], page.total) == (made[:10], 50)
    catalogue.reconstructions.set(made[9], state=JobState.RUNNING)
    page = order.page(10, page.next_cursor)
    assert [(row.id, row.queue_place) for row in page.items] == [(made[n], n) for n in range(10, 20)]
    assert [row.id for row in order.released()] == [*made[:9], *made[10:]]
    with pytest.raises(UnknownIdError, match="list anew"):
        order.page(10, "01a20000-0000-7000-8000-999999999999")


def test_there_is_always_a_turn_between_two() -> None:
    low, high = "", "01a20000"
    for _ in range(200):
        high = turn_between(low, high)
        assert low < high < "01a20000"
    assert turn_between("5", None) == turn_between("5", "5") == "58"
