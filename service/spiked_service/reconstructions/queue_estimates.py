"""Places and expected completion times of queued reconstructions."""

import statistics
from collections.abc import Iterable, Sequence
from dataclasses import replace
from datetime import UTC, datetime

from spiked.recon.time_left import typical_work_s
from spiked_service.store.catalogue import Catalogue
from spiked_service.store.rows import JobState, ReconstructionRow, Task

NEXT = "state = ? ORDER BY priority DESC, coalesce(nullif(json_extract(document, '$.turn'), ''), id)"
"""SQL condition and order of the queue; the parameter is a state."""
_RECENT = 8
"""Complete reconstructions that the pace is estimated from."""
_MERGE_SHARE, _LOCALISATION_SHARE = 0.2, 0.1
"""Time of a merge, and of localising all frames, over that of reconstructing the capture (decisions 16 and 18)."""
_CHANGE_S = 5.0
"""Changes of an estimate by less seconds, ..."""
_CHANGE_SHARE = 0.2
"""... or by a smaller share of it, are not published."""


class QueueEstimates:
    """Estimates places and times of the queue. Not thread-safe."""

    def __init__(self, catalogue: Catalogue) -> None:
        self._catalogue = catalogue
        self._published: dict[str, tuple[int | None, float | None]] = {}

    def queued(self, running: Sequence[ReconstructionRow], limit: int) -> list[ReconstructionRow]:
        """Queued rows, the next one first, with their place and the seconds to their completion, where known.

        `running` are the rows with a worker; at most `limit` run at a time.
        """
        rows = self._catalogue.reconstructions.where(NEXT, (str(JobState.QUEUED),))
        if not rows:
            return []
        free_s = sorted(_remaining_s(row) for row in running)[max(0, len(running) - limit) :]
        free_s = [0.0] * (limit - len(free_s)) + free_s
        paces = self._paces(running)
        pace = statistics.median(paces) if paces else float("inf")
        found = []
        for place, row in enumerate(rows, 1):
            if row.held:
                found.append(replace(row, queue_place=place, eta_s=None))
                continue
            free_s.sort()
            end_s = free_s[0] = free_s[0] + pace * (self._effort(row) or float("inf"))
            found.append(replace(row, queue_place=place, eta_s=end_s if end_s < float("inf") else None))
        return found

    def changed(self, queued: Iterable[ReconstructionRow]) -> list[ReconstructionRow]:
        """Rows whose place or time differs from what the last call returned."""
        before, self._published, changed = self._published, {}, []
        for row in queued:
            place, eta_s = before.get(row.id, (None, None))
            if row.queue_place == place and _alike(row.eta_s, eta_s):
                self._published[row.id] = (place, eta_s)
            else:
                self._published[row.id] = (row.queue_place, row.eta_s)
                changed.append(row)
        return changed

    def forget(self, reconstruction_id: str) -> None:
        """Let `changed` return this row again."""
        self._published.pop(reconstruction_id, None)

    def _paces(self, running: Sequence[ReconstructionRow]) -> list[float]:
        """Seconds per unit of effort, of running and recently completed rows."""
        over = self._catalogue.reconstructions.where(
            "state = ? ORDER BY id DESC LIMIT ?", (str(JobState.COMPLETE), _RECENT)
        )
        now, found = datetime.now(UTC), []
        for row in (*running, *over):
            effort = self._effort(row) if row.task.reconstructs else None
            if row.started_at is not None and effort is not None:
                left_s = 0.0 if row.ended_at else _remaining_s(row)
                found.append((((row.ended_at or now) - row.started_at).total_seconds() + left_s) / effort)
        return [pace for pace in found if pace < float("inf")]

    def _effort(self, row: ReconstructionRow) -> float | None:
        """Seconds of work on a reference machine; None while the recording is not closed."""
        capture = self._catalogue.captures.find(row.capture_id)
        if capture is None or capture.sensor is None or capture.recording is None or not capture.recording.frames:
            return None
        width, height, frames = capture.sensor.width, capture.sensor.height, capture.recording.frames
        match row.task:
            case Task.MERGE:
                share = _MERGE_SHARE
            case Task.LOCALISE:
                share = _LOCALISATION_SHARE * (min(row.part.count, frames) / frames if row.part else 1)
            case _:
                share = 1.0
        return share * typical_work_s(width, height, frames, row.options.steps)


def _remaining_s(row: ReconstructionRow) -> float:
    return float("inf") if row.eta_s is None else row.eta_s


def _alike(one: float | None, other: float | None) -> bool:
    if one is None or other is None:
        return one is other
    return abs(one - other) < max(_CHANGE_S, _CHANGE_SHARE * other)
