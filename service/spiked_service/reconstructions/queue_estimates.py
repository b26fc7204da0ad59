"""Places and expected completion times of queued reconstructions."""

import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property, lru_cache

from spiked.recon.time_left import typical_work_s
from spiked_service.reconstructions.queue_order import QueueOrder
from spiked_service.store.catalogue import Catalogue
from spiked_service.store.rows import JobState, ReconstructionRow, Task, placed

FRONT = 100
"""Jobs whose times are estimated one by one, and whose changes of place are published; the others have the mean."""
_RECENT = 8
"""Complete reconstructions that the pace is estimated from."""
_MERGE_SHARE, _LOCALISATION_SHARE = 0.2, 0.1
"""Time of a merge, and of localising all frames, over that of reconstructing the capture (decisions 16 and 18)."""
_CHANGE_S = 5.0
"""Changes of an estimate by less seconds, ..."""
_CHANGE_SHARE = 0.2
"""... or by a smaller share of it, are not published."""

_typical_work_s = lru_cache(1024)(typical_work_s)
"""Jobs of a queue are alike, and computing it takes most of a millisecond."""


@dataclass(frozen=True)
class Front:
    """The jobs at the front of the queue, and when those behind them can begin."""

    rows: Sequence[ReconstructionRow]
    """With places and the seconds to their completion, where known."""
    begins_s: float
    """Seconds until the next one behind them begins; infinite if not known."""
    each_s: float
    """Mean seconds from one completion to the next."""

    @cached_property
    def by_id(self) -> dict[str, ReconstructionRow]:
        """The rows by id."""
        return {row.id: row for row in self.rows}

    def placed(self, row: ReconstructionRow, place: int) -> ReconstructionRow:
        """A queued row with its place in the queue and the seconds to its completion, where known."""
        known = self.by_id.get(row.id)
        if known is not None:
            return placed(row, place, known.eta_s)
        end_s = self.begins_s + self.each_s * max(1, place - len(self.rows))
        return placed(row, place, None if row.held or end_s == float("inf") else end_s)


class QueueEstimates:
    """Estimates places and times of the queue. Not thread-safe."""

    def __init__(self, catalogue: Catalogue, order: QueueOrder) -> None:
        self._catalogue = catalogue
        self._order = order
        self._published: dict[str, tuple[int | None, float | None]] = {}
        self._recordings: dict[str, tuple[int, int, int]] = {}

    def front(self, running: Sequence[ReconstructionRow], limit: int) -> Front:
        """The front of the queue; `running` are the rows with a worker; at most `limit` run at a time."""
        rows = self._order.first(FRONT)
        if not rows:
            return Front((), 0.0, float("inf"))
        free_s = sorted(_remaining_s(row) for row in running)[max(0, len(running) - limit) :]
        free_s = [0.0] * (limit - len(free_s)) + free_s
        over = self._recent()
        efforts = self._efforts([*running, *over, *rows])
        paces = _paces([*running, *over], efforts)
        pace = statistics.median(paces) if paces else float("inf")
        found = []
        for place, row in enumerate(rows, 1):
            if row.held:
                found.append(placed(row, place, None))
                continue
            free_s.sort()
            end_s = free_s[0] = free_s[0] + pace * efforts.get(row.id, float("inf"))
            found.append(placed(row, place, end_s if end_s < float("inf") else None))
        known = [efforts[row.id] for row in rows if row.id in efforts]
        each_s = pace * statistics.mean(known) / limit if known else float("inf")
        return Front(found, min(free_s), each_s)

    def told(self, row: ReconstructionRow) -> None:
        """Note that a row was published, with its place and time."""
        self._published.pop(row.id, None)
        if row.queue_place is not None and row.queue_place <= FRONT:
            self._published[row.id] = (row.queue_place, row.eta_s)

    def changed(self, front: Front) -> list[ReconstructionRow]:
        """Rows of the front whose place or time differs from what was published, and those that have left it and are
        still queued; they count as published now."""
        before, self._published, changed = self._published, {}, []
        for row in front.rows:
            place, eta_s = before.get(row.id, (None, None))
            if row.queue_place == place and _alike(row.eta_s, eta_s):
                self._published[row.id] = (place, eta_s)
            else:
                self._published[row.id] = (row.queue_place, row.eta_s)
                changed.append(row)
        behind = [one for one in before if one not in self._published]
        for row_id, place in self._order.places(behind).items():
            behind_row = self._catalogue.reconstructions.find(row_id)
            if behind_row is not None:
                changed.append(front.placed(behind_row, place))
        return changed

    def _recent(self) -> list[ReconstructionRow]:
        """Rows that were completed last."""
        return self._catalogue.reconstruction_page(_RECENT, state=JobState.COMPLETE).items

    def _efforts(self, rows: Sequence[ReconstructionRow]) -> dict[str, float]:
        """Seconds of work on a reference machine, by row, without those whose recording is not closed."""
        asked = {row.capture_id for row in rows}
        self._recordings = {key: known for key, known in self._recordings.items() if key in asked}
        ids = tuple(asked - self._recordings.keys())
        for one in self._catalogue.captures.where(f"id IN ({', '.join('?' * len(ids))})", ids) if ids else ():
            if one.sensor is not None and one.recording is not None and one.recording.frames:
                self._recordings[one.id] = (one.sensor.width, one.sensor.height, one.recording.frames)
        return {
            row.id: _effort(row, *self._recordings[row.capture_id])
            for row in rows
            if row.capture_id in self._recordings
        }


def _paces(rows: Sequence[ReconstructionRow], efforts: dict[str, float]) -> list[float]:
    """Seconds per unit of effort, of running and recently completed rows."""
    now, found = datetime.now(UTC), []
    for row in rows:
        if row.started_at is not None and row.task.reconstructs and row.id in efforts:
            left_s = 0.0 if row.ended_at else _remaining_s(row)
            found.append((((row.ended_at or now) - row.started_at).total_seconds() + left_s) / efforts[row.id])
    return [pace for pace in found if pace < float("inf")]


def _effort(row: ReconstructionRow, width: int, height: int, frames: int) -> float:
    """Seconds of work on a reference machine."""
    match row.task:
        case Task.MERGE:
            share = _MERGE_SHARE
        case Task.LOCALISE:
            share = _LOCALISATION_SHARE * (min(row.part.count, frames) / frames if row.part else 1)
        case _:
            share = 1.0
    return share * _typical_work_s(width, height, frames, row.options.steps)


def _remaining_s(row: ReconstructionRow) -> float:
    return float("inf") if row.eta_s is None else row.eta_s


def _alike(one: float | None, other: float | None) -> bool:
    if one is None or other is None:
        return one is other
    return abs(one - other) < max(_CHANGE_S, _CHANGE_SHARE * other)
