"""The order of the queue: places in it, parts of it, and moves, however long it is."""

from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

from spiked_service.store.catalogue import NOT_PURGED, Catalogue, Page, UnknownIdError
from spiked_service.store.rows import JobState, ReconstructionRow, placed

_CHUNK = 16
"""Jobs that are read at once where most often the first one is wanted."""
_DIGITS = (6, 8, 11, 13)
"""Digits of turns for which `queue_blocks` counts: an id's time in steps of 4.7 h, 65 s, 0.26 s and 1 ms."""
_ABOVE = "\x7f"
"""Above all characters of a turn."""
_NEAR = 256
"""Jobs between two places that are counted one by one."""
_USERS = 1000
"""Users who take turns; more share the last one."""
_ROWS = (
    "SELECT document FROM queue CROSS JOIN reconstructions USING (id) WHERE "
    "recording NOT IN (SELECT capture_id FROM purges) "
    f"AND (recording <> '' OR reconstructions.{NOT_PURGED})"  # a merge reads none
)
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
        query = "SELECT coalesce(sum(jobs), 0) FROM queue_blocks WHERE digits = ?"
        gone = (
            "SELECT coalesce(sum(jobs), 0) FROM purges CROSS JOIN job_counts USING (capture_id) "
            "WHERE job_counts.state = ?"
        )
        ((count,),) = self._catalogue.read(f"SELECT ({query}) - ({gone})", (_DIGITS[0], str(JobState.QUEUED)))
        return int(count)

    def first(self, count: int) -> list[ReconstructionRow]:
        """The next `count` jobs, the first one first."""
        return self._rows(f"{_ROWS} {_IN_TURN}", (count,))

    def released(self, passed: Collection[str] = ()) -> Iterator[ReconstructionRow]:
        """All that are not held, the next one first; read on demand, so what changes meanwhile is seen.

        Those that read the recordings of captures that are `passed`, also meanwhile, are left out.
        """
        condition, values = "NOT held", tuple[Any, ...]()
        while True:
            others = f"recording NOT IN ({', '.join('?' * len(passed))})"
            rows = self._rows(f"{_ROWS} AND {condition} AND {others} {_IN_TURN}", (*values, *passed, _CHUNK))
            if not rows:
                return
            yield from (row for row in rows if row.capture_id not in passed or not row.task.reads_recording)
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
        rows = self._rows(f"{_ROWS} AND {condition} {_IN_TURN}", (*values, limit + 1))
        begin = self._place(turn_of(rows[0])) if rows else 0
        items = [placed(row, place, row.eta_s) for place, row in enumerate(rows[:limit], begin)]
        return Page(items, rows[limit - 1].id if len(rows) > limit else None, len(self))

    def places(self, ids: Iterable[str]) -> dict[str, int]:
        """Places of those that are queued, from 1."""
        if not (wanted := tuple(ids)):
            return {}
        marks = ", ".join("?" * len(wanted))
        found = self._catalogue.read(f"SELECT urgency, turn, id FROM queue WHERE id IN ({marks})", wanted)
        places, place, before = dict[str, int](), 0, Turn(-(2**62), "", "")
        # Turns are compared alone, too: SQLite ends a search at an upper bound of one column only.
        near = "SELECT 1 FROM queue WHERE urgency = ? AND turn BETWEEN ? AND ? AND (turn, id) > (?, ?)"
        for turn in sorted(Turn(*key) for key in found):
            between = (turn.urgency, before.turn, turn.turn, before.turn, before.id, turn.turn, turn.id, _NEAR)
            count = _NEAR
            if turn.urgency == before.urgency:
                query = f"SELECT count(*) FROM ({near} AND (turn, id) <= (?, ?) LIMIT ?)"
                ((count,),) = self._catalogue.read(query, between)
            place, before = place + count if count < _NEAR else self._place(turn), turn
            places[turn.id] = place
        return places

    def _place(self, turn: Turn) -> int:
        """The place of a queued job: those before its block of turns, and those of the block up to it."""
        query = "SELECT coalesce(sum(jobs), 0) FROM queue_blocks WHERE digits = ? AND"
        place, block = 0, ""
        for digits in _DIGITS:
            low, block = block, turn.turn[:digits]
            if digits == _DIGITS[0]:
                before = self._catalogue.read(f"{query} (urgency, block) < (?, ?)", (digits, turn.urgency, block))
            else:
                inside = f"{query} urgency = ? AND block >= ? AND block < ?"
                before = self._catalogue.read(inside, (digits, turn.urgency, low, block))
            place += before[0][0]
        query = "SELECT count(*) FROM queue WHERE urgency = ? AND turn BETWEEN ? AND ? AND (turn, id) <= (?, ?)"
        ((count,),) = self._catalogue.read(query, (turn.urgency, block, turn.turn, turn.turn, turn.id))
        return int(place + count)

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
        left, inside, values = place - 1, "", tuple[Any, ...]()
        for digits in _DIGITS:
            query = f"SELECT urgency, block, jobs FROM queue_blocks WHERE digits = ?{inside} ORDER BY urgency, block"
            for urgency, block, jobs in self._catalogue.read(query, (digits, *values)):
                if left < jobs:
                    inside = " AND urgency = ? AND block BETWEEN ? AND ? AND substr(block, 1, ?) = ?"
                    values = (urgency, block, f"{block}{_ABOVE}", digits, block)
                    break
                left -= jobs
            else:
                return None
        query = "SELECT urgency, turn, id FROM queue WHERE urgency = ? AND turn >= ? ORDER BY turn, id LIMIT 1 OFFSET ?"
        found = self._catalogue.read(query, (*values[:2], left))
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
