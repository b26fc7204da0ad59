"""Reads the values of the metrics from rings, captures, jobs and workers."""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from spiked.ring import LossCause
from spiked_service.captures.captures import Captures
from spiked_service.operations.metrics import MetricsSource, RingSample
from spiked_service.reconstructions.queue import Reconstructions
from spiked_service.store.catalogue import Catalogue
from spiked_service.store.rows import Counters, Recorded
from spiked_service.workers.messages import Role


def metrics_source_of(
    captures: Captures, reconstructions: Reconstructions, catalogue: Catalogue, data: Path
) -> MetricsSource:
    """The source for `Metrics`."""
    counted: set[str] = set()

    def rings() -> Iterator[RingSample]:
        now = captures.rings()
        counted.intersection_update(one.ring_id for one in now)
        for one in now:
            if one.ring_id in counted:
                continue
            if one.over:
                counted.add(one.ring_id)
            on_disk = lost_behind_ring(one.recording, one.counters)
            yield RingSample(one.ring_id, device_name(one.source), one.counters, one.over, on_disk)

    def workers() -> dict[str, int]:
        found = Counter(role for roles in captures.processes().values() for role in roles)
        found[Role.RECONSTRUCTION] += len(reconstructions.processes())
        return found

    return MetricsSource(
        rings=rings,
        captures_by_state=catalogue.capture_counts,
        recordings_by_grade=catalogue.grade_counts,
        reconstructions_by_state=lambda: {str(state): count for state, count in reconstructions.rows.counts().items()},
        workers_by_role=workers,
        data=lambda: data,
    )


def lost_behind_ring(recording: Recorded | None, counters: Counters) -> int:
    """Frames that the ring had and the disk did not take.

    A replayed recording brings gaps of cause disk through the ring, which counts them: its copy lists them again.
    """
    if recording is None:
        return 0
    return max(0, recording.lost_by_cause.get(LossCause.DISK, 0) - counters.lost.get(LossCause.DISK, 0))


def device_name(source: str) -> str:
    """A source without its options, which differ between captures."""
    return source.partition("?")[0]
