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


def join(catalogue: Catalogue, number: int, user: str, priority: int = 0) -> str:
    """Queue a job of a user as the service does. Return its id."""
    row_id = f"01a20000-0000-7000-8000-{number:012d}"
    row = ReconstructionRow(row_id, "capture", False, JobState.QUEUED, BEGAN, priority=priority, user=user)
    catalogue.reconstructions.put(QueueOrder(catalogue).fair(row))
    return row_id


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


def users(catalogue: Catalogue) -> str:
    return "".join(row.user for row in QueueOrder(catalogue).first(1000))


def test_users_take_turns_and_each_ones_jobs_keep_their_order(catalogue: Catalogue) -> None:
    made = [join(catalogue, number, "a") for number in range(6)]
    assert ids(QueueOrder(catalogue)) == made, "one user alone: in the order of their age"
    others = [join(catalogue, 10 + number, user) for number, user in enumerate("bbcb")]
    assert users(catalogue) == "abcababaaa"
    order = ids(QueueOrder(catalogue))
    assert [one for one in order if one in made] == made
    assert [one for one in order if one in others and one != others[2]] == [others[0], others[1], others[3]]
    join(catalogue, 20, "a")
    assert users(catalogue) == "abcababaaaa", "the last of who has the most"
    join(catalogue, 21, "d", priority=1)
    assert users(catalogue) == "dabcababaaaa", "priorities come first"
    catalogue.reconstructions.set(made[0], state=JobState.RUNNING)
    join(catalogue, 22, "e")
    assert users(catalogue).index("e") <= 4, "nobody waits for more than one job of each other"


def test_any_jobs_of_any_users_are_mixed(catalogue: Catalogue) -> None:
    dice = random.Random(3)
    made: dict[str, list[str]] = {user: [] for user in "abcde"}
    for number in range(200):
        user = dice.choice("aaaaaabbcde")
        made[user].append(join(catalogue, number, user))
    order = [(row.id, row.user) for row in QueueOrder(catalogue).first(1000)]
    for user, jobs in made.items():
        assert [one for one, of in order if of == user] == jobs
    waiting = "".join(user for _, user in order)
    assert waiting.rindex("d") < 5 * (waiting.count("d") + 1), "few jobs are done soon"
