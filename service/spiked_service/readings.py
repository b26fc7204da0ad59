"""What the metrics read of captures, jobs and workers at each scrape."""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from spiked_service.captures import Captures
from spiked_service.live import LiveSettings
from spiked_service.metrics import Reading, Readings
from spiked_service.store.folder import default_folder
from spiked_service.store.rows import Counters


def readings_of(captures: Captures, settings: LiveSettings) -> Readings:
    """Everything that `Metrics` asks for."""
    counted: set[str] = set()

    def running() -> Iterator[Reading]:
        for capture in captures.all():
            snapshot = capture.snapshot()
            if snapshot.counters is None or snapshot.id in counted:
                continue
            if snapshot.state.over:
                counted.add(snapshot.id)
            device = device_name(snapshot.plan.source)
            yield Reading(snapshot.id, device, Counters.of(snapshot.counters), snapshot.state.over)

    def workers() -> dict[str, int]:
        return Counter(role for capture in captures.all() for role in capture.processes())

    return Readings(
        captures=running,
        captures_by_state=lambda: Counter(str(capture.snapshot().state) for capture in captures.all()),
        reconstructions_by_state=dict,
        workers_by_role=workers,
        data=lambda: existing((settings.now.data or default_folder()).absolute()),
    )


def device_name(source: str) -> str:
    """A source without its options, which may be different for every capture."""
    return source.partition("?")[0]


def existing(folder: Path) -> Path:
    """The folder, or the nearest above it that is there."""
    return next(path for path in (folder, *folder.parents) if path.exists())
