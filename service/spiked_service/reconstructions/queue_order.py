"""The order of the queue: places in it, parts of it, and moves, however long it is."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

from spiked_service.store.catalogue import Catalogue, Page, UnknownIdError
from spiked_service.store.rows import ReconstructionRow

_CHUNK = 16
"""Jobs that are read at once where most often the first one is wanted."""
_USERS = 1000
"""Users who take turns; more share the last one."""
_ROWS = "SELECT document FROM queue CROSS JOIN reconstructions USING (id)"
_IN_TURN = "ORDER BY urgency, turn, id LIMIT ?"


@dataclass(frozen=True, order=True)
class Turn:
    """The key that the queue is sorted by."""

    urgency: int
    """The priority times -1."""
    turn: str
    id: str


class QueueOrder:
    """Reads the table `queue`, which triggers of the catalogue keep in step with the reconstructions."""

    def __init__(self, catalogue: Catalogue) -> None:
        self._catalogue = catalogue

    def __len__(self) -> int:
        """Number of queued jobs, held ones included."""
        ((count,),) = self._catalogue.read("SELECT count(*) FROM queue")
        return int(count)

    def first(self, count: int) -> list[ReconstructionRow]:
        """The next `count` jobs, the first one first."""
        return self._rows(f"{_ROWS} {_IN_TURN}", (count,))

    def released(self) -> Iterator[ReconstructionRow]:
        """All that are not held, the next one first; read on demand, so what changes meanwhile is seen."""
        condition, values = "NOT held", tuple[Any, ...]()
        while rows := self._rows(f"{_ROWS} WHERE {condition} {_IN_TURN}", (*values, _CHUNK)):
            yield from rows
            condition, values = "NOT held AND (urgency, turn, id) > (?, ?, ?)", _values(turn_of(rows[-1]))

    def page(self, limit: int, cursor: str | None) -> Page[ReconstructionRow]:
        """A page of the queue with places and the length of the queue; the cursor is the id of the job before it.

        Raises UnknownIdError for the cursor of a job that was removed meanwhile.
        """
        condition, values = "1", tuple[Any, ...]()
        if cursor is not None:
            last = self._catalogue.reconstructions.find(cursor)
            if last is None:
                raise UnknownIdError(f"reconstruction {cursor}, after which the list goes on, is gone; list anew")
            condition, values = "(urgency, turn, id) > (?, ?, ?)", _values(turn_of(last))
        rows = self._rows(f"{_ROWS} WHERE {condition} {_IN_TURN}", (*values, limit + 1))
        places = self.places(row.id for row in rows[:limit])
        items = [replace(row, queue_place=places.get(row.id)) for row in rows[:limit]]
        return Page(items, rows[limit - 1].id if len(rows) > limit else None, len(self))

    def places(self, ids: Iterable[str]) -> dict[str, int]:
        """Places of those that are queued, from 1; the table is passed once, however many there are."""
        wanted = tuple(ids)
        marks = ", ".join("?" * len(wanted))
        found = self._catalogue.read(f"SELECT urgency, turn, id FROM queue WHERE id IN ({marks})", wanted)
        places, place, before = dict[str, int](), 0, Turn(-(2**62), "", "")
        for turn in sorted(Turn(*key) for key in found):
            ((count,),) = self._catalogue.read(
                "SELECT count(*) FROM queue WHERE (urgency, turn, id) > (?, ?, ?) AND (urgency, turn, id) <= (?, ?, ?)",
                (*_values(before), *_values(turn)),
            )
            place, before = place + count, turn
            places[turn.id] = place
        return places

    def moved(self, row: ReconstructionRow, place: int) -> ReconstructionRow:
        """The row as it is to be saved to have this place; beyond the end: the last one. No other row changes.

        It takes the priority of the job whose place it gets. That of a row that is not queued stays.
        """
        before = self.places([row.id]).get(row.id)
        place = min(place, len(self))
        if before is None or place == before:
            return row
        first, second = (place - 1, place) if place < before else (place, place + 1)
        low, high = self._at(first), self._at(second)
        taken = high if place < before else low
        assert taken is not None, "the place is one of the queue"
        return replace(
            row,
            priority=-taken.urgency,
            turn=turn_between(
                low.turn if low is not None and low.urgency == taken.urgency else "",
                high.turn if high is not None and high.urgency == taken.urgency else None,
            ),
        )

    def fair(self, row: ReconstructionRow) -> ReconstructionRow:
        """The row of a job that joins the queue, with its turn: behind those of its user, and one of each other user.

        So users with many jobs and users with few take turns, and each one's jobs keep their order.
        """
        urgency = -row.priority
        own = "SELECT coalesce(max(turn), '') FROM queue WHERE urgency = ? AND user = ? AND id <> ?"
        ((low,),) = self._catalogue.read(own, (urgency, row.user, row.id))
        after = "SELECT turn, user FROM queue WHERE urgency = ? AND turn > ? AND id <> ? ORDER BY turn, id LIMIT ?"
        high, passed = None, set[str]()
        for turn, user in self._catalogue.read(after, (urgency, low, row.id, _USERS)):
            if user in passed:
                high = turn
                break
            passed.add(user)
            low = turn
        last = high is None and row.id > low
        return replace(row, turn="" if last else turn_between(low, high))

    def _at(self, place: int) -> Turn | None:
        """The key of the job at a place; None outside of the queue."""
        if place < 1:
            return None
        found = self._catalogue.read(f"SELECT urgency, turn, id FROM queue {_IN_TURN} OFFSET ?", (1, place - 1))
        return Turn(*found[0]) if found else None

    def _rows(self, query: str, values: tuple[Any, ...]) -> list[ReconstructionRow]:
        return [self._catalogue.reconstructions.parse(document) for (document,) in self._catalogue.read(query, values)]


def turn_of(row: ReconstructionRow) -> Turn:
    """Its key, as the triggers make it."""
    return Turn(-row.priority, row.turn or row.id, row.id)


def turn_between(low: str, high: str | None) -> str:
    """A text that sorts between two others as bytes do; `low` may be empty, and without `high` there is no upper limit.

    Turns that are alike, as an earlier release could leave them, have nothing between them: then it follows both.
    No text that is returned ends with "0", below which there would be no other.
    """
    if high is None or high == low or not high.startswith(low):
        return f"{low}8"
    rest = high[len(low) :]
    digits = rest.lstrip("0")
    zeros = low + "0" * (len(rest) - len(digits))
    middle = chr((ord("0") + ord(digits[0])) // 2)
    return f"{zeros}08" if middle == "0" else f"{zeros}{middle}"


def _values(turn: Turn) -> tuple[int, str, str]:
    return turn.urgency, turn.turn, turn.id
