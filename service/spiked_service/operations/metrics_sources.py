"""Reads the values of the metrics from captures, jobs and workers."""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from spiked.ring import LossCause
from spiked_service.captures.captures import Captures
from spiked_service.operations.metrics import CaptureSample, MetricsSource
from spiked_service.reconstructions.queue import Reconstructions
from spiked_service.workers.messages import Role


def metrics_source_of(captures: Captures, reconstructions: Reconstructions, data: Path) -> MetricsSource:
    """The source for `Metrics`."""
    counted: set[str] = set()

    def running() -> Iterator[CaptureSample]:
        for snapshot in captures.recent():
            over = snapshot.row.state.over
            if snapshot.counters is None or snapshot.id in counted:
                continue
            if over:
                counted.add(snapshot.id)
            recording = snapshot.row.recording
            on_disk = 0 if recording is None else recording.lost_by_cause.get(LossCause.DISK, 0)
            yield CaptureSample(snapshot.id, device_name(snapshot.row.source), snapshot.counters, over, on_disk)

    def workers() -> dict[str, int]:
        found = Counter(role for roles in captures.processes().values() for role in roles)
        found[Role.RECONSTRUCTION] += len(reconstructions.processes())
        return found

    return MetricsSource(
        captures=running,
        captures_by_state=captures.counts,
        reconstructions_by_state=lambda: {str(state): count for state, count in reconstructions.rows.counts().items()},
        workers_by_role=workers,
        data=lambda: data,
    )


def device_name(source: str) -> str:
    """A source without its options, which differ between captures."""
    return source.partition("?")[0]
