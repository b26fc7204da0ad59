"""What the metrics read of captures, jobs and workers at each scrape."""

from collections import Counter
from collections.abc import Iterator

from spiked_service.keeping import Keeping
from spiked_service.messages import Role
from spiked_service.metrics import Reading, Readings


def readings_of(keeping: Keeping) -> Readings:
    """Everything that `Metrics` asks for."""
    counted: set[str] = set()
    captures, reconstructions = keeping.captures, keeping.reconstructions

    def running() -> Iterator[Reading]:
        for snapshot in captures.recent():
            over = snapshot.row.state.over
            if snapshot.counters is None or snapshot.id in counted:
                continue
            if over:
                counted.add(snapshot.id)
            yield Reading(snapshot.id, device_name(snapshot.row.source), snapshot.counters, over)

    def workers() -> dict[str, int]:
        found = Counter(role for roles in captures.processes().values() for role in roles)
        found[Role.RECONSTRUCTION] += len(reconstructions.processes())
        return found

    return Readings(
        captures=running,
        captures_by_state=captures.counts,
        reconstructions_by_state=lambda: {str(state): count for state, count in reconstructions.counts().items()},
        workers_by_role=workers,
        data=lambda: keeping.folder.path,
    )


def device_name(source: str) -> str:
    """A source without its options, which may be different for every capture."""
    return source.partition("?")[0]
