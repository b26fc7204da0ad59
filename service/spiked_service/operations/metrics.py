"""Metrics for Prometheus: counters of the rings, states, latencies and limits."""

import os
import platform
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from prometheus_client import CollectorRegistry, Histogram, ProcessCollector, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, InfoMetricFamily, Metric
from prometheus_client.registry import Collector

from spiked.blocks import instruction_sets
from spiked.ring import DeviceState, LossCause
from spiked_service.base.health import CheckStatus, Health
from spiked_service.base.limits import ConcurrencyLimit
from spiked_service.base.version import installed_version
from spiked_service.events.bus import Bus, Message, Topic
from spiked_service.events.payloads import PosePayload
from spiked_service.store.rows import Counters

_POSE_S = (0.002, 0.005, 0.01, 0.02, 0.03, 0.05, 0.075, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
"""Bucket bounds of the latency of poses, seconds."""
_REQUEST_S = (0.002, 0.005, 0.01, 0.015, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 10.0)
"""Bucket bounds of the time of requests, seconds."""


@dataclass(frozen=True)
class RingSample:
    """A ring, of a capture or an armed device, at the moment of a scrape."""

    ring_id: str
    device: str
    """Source without its options, so that the label values stay few."""
    counters: Counters
    over: bool
    """Whether the counters are final."""
    lost_on_disk: int = 0
    """Frames that reached the ring and were lost to the disk."""


@dataclass(frozen=True)
class MetricsSource:
    """Callables that the metrics are read from at each scrape."""

    rings: Callable[[], Iterable[RingSample]]
    """Running ones, and once those that ended since the last call."""
    captures_by_state: Callable[[], dict[str, int]]
    recordings_by_grade: Callable[[], dict[str, int]]
    reconstructions_by_state: Callable[[], dict[str, int]]
    workers_by_role: Callable[[], dict[str, int]]
    data: Callable[[], Path]
    """The data folder."""


class Metrics:
    """The metrics of one service, in their own registry."""

    def __init__(self, source: MetricsSource, bus: Bus, health: Health, limits: Mapping[str, ConcurrencyLimit]) -> None:
        self._registry = CollectorRegistry()
        self.request_s = Histogram(
            "spiked_http_request_seconds",
            "From a request's arrival to the end of its answer.",
            ["method", "route", "status"],
            buckets=_REQUEST_S,
            registry=self._registry,
        )
        self.pose_latency_s = Histogram(
            "spiked_pose_latency_seconds",
            "From the arrival of a block's last frame in the ring to the message with its pose.",
            buckets=_POSE_S,
            registry=self._registry,
        )
        ProcessCollector(registry=self._registry)
        self._registry.register(_Collector(source, bus, health, limits))
        bus.observe(self._observe_latency)

    def exposition(self) -> bytes:
        """All metrics in the Prometheus text format."""
        return generate_latest(self._registry)

    def _observe_latency(self, message: Message) -> None:
        if isinstance(message.payload, PosePayload) and message.payload.latency_s is not None:
            self.pose_latency_s.observe(message.payload.latency_s)


class _Totals:
    """Frame counters by device, summed over rings."""

    def __init__(self) -> None:
        self._seen: dict[str, Counter[tuple[str, ...]]] = {}
        self.totals: Counter[tuple[str, ...]] = Counter()

    def add(self, sample: RingSample) -> None:
        """Add the difference since the last sample of this ring."""
        device, counters = sample.device, sample.counters
        now: Counter[tuple[str, ...]] = Counter({("received", device): counters.received})
        now.update({("lost", device, cause): count for cause, count in counters.lost.items()})
        now["lost", device, str(LossCause.DISK)] += sample.lost_on_disk
        for consumer in counters.consumers:
            now["read", device, consumer.name] += consumer.frames_read
            now["missed", device, consumer.name] += consumer.lost
        before = self._seen.pop(sample.ring_id, Counter())
        for key, count in now.items():
            self.totals[key] += max(0, count - before[key])
        if not sample.over:
            self._seen[sample.ring_id] = now


class _Collector(Collector):
    """Reads all values at each scrape."""

    def __init__(self, source: MetricsSource, bus: Bus, health: Health, limits: Mapping[str, ConcurrencyLimit]) -> None:
        self._source = source
        self._bus = bus
        self._health = health
        self._concurrency = limits
        self._totals = _Totals()
        self._lock = threading.Lock()

    def describe(self) -> Iterable[Metric]:
        """Return nothing, because registering must not read values."""
        return ()

    def collect(self) -> Iterator[Metric]:
        """All metric families."""
        yield InfoMetricFamily("spiked_build", "Version and platform.", value=_build())
        yield from self._frames()
        yield _states("spiked_captures", "Captures by state.", self._source.captures_by_state())
        yield _states("spiked_recordings", "Recordings by quality.", self._source.recordings_by_grade(), "grade")
        yield _states("spiked_reconstructions", "Jobs by state.", self._source.reconstructions_by_state())
        yield _states("spiked_workers", "Worker processes.", self._source.workers_by_role(), "role")
        yield from self._events()
        yield from self._limits()
        yield from _disk(self._source.data())
        health = GaugeMetricFamily("spiked_check_failed", "1 where a check of readyz fails.", labels=["check"])
        for finding in self._health.readiness():
            health.add_metric([finding.name], float(finding.verdict is CheckStatus.FAILED))
        yield health

    def _frames(self) -> Iterator[Metric]:
        with self._lock:  # of two scrapes at a time the second must not bring older counters
            samples = list(self._source.rings())
            for sample in samples:
                self._totals.add(sample)
            totals = Counter(self._totals.totals)
        live = [sample for sample in samples if not sample.over]
        device, consumer = ["device"], ["device", "consumer"]
        families = {
            "received": CounterMetricFamily("spiked_frames_received", "Frames written into the ring.", labels=device),
            "lost": CounterMetricFamily(
                "spiked_frames_lost",
                "Frames lost before the ring or on the disk, by cause.",
                labels=["device", "cause"],
            ),
            "read": CounterMetricFamily("spiked_consumer_frames", "Frames that a consumer read.", labels=consumer),
            "missed": CounterMetricFamily(
                "spiked_consumer_frames_lost", "Frames that a consumer did not read.", labels=consumer
            ),
        }
        for sample in live:
            totals.update({("lost", sample.device, str(cause)): 0 for cause in LossCause})
        for (kind, *labels), count in sorted(totals.items()):
            families[kind].add_metric(labels, count)
        yield from families.values()
        fill = GaugeMetricFamily(
            "spiked_ring_fill_ratio", "Lag of a consumer as a share of the ring; at 1 it loses frames.", labels=consumer
        )
        lag = GaugeMetricFamily("spiked_consumer_lag_frames", "Frames a consumer is behind.", labels=consumer)
        lagging = GaugeMetricFamily("spiked_consumer_lagging", "1 while a consumer is overrun.", labels=consumer)
        state = GaugeMetricFamily(
            "spiked_device_state", "1 for the current state of the device.", labels=["device", "state"]
        )
        for sample in live:
            for one in sample.counters.consumers:
                labels = [sample.device, one.name]
                fill.add_metric(labels, one.fill)
                lag.add_metric(labels, one.lag_frames)
                lagging.add_metric(labels, float(one.lagging))
            for each in DeviceState:
                state.add_metric([sample.device, each], float(each is sample.counters.device))
        yield from (fill, lag, lagging, state)

    def _events(self) -> Iterator[Metric]:
        published = CounterMetricFamily("spiked_events_published", "Messages on the bus.", labels=["topic"])
        dropped = CounterMetricFamily("spiked_events_dropped", "Messages dropped for slow clients.", labels=["topic"])
        published_counts, dropped_counts = self._bus.published(), self._bus.dropped()
        for topic in Topic:
            if topic is not Topic.LOST:
                published.add_metric([topic], published_counts.get(topic, 0))
                dropped.add_metric([topic], dropped_counts.get(topic, 0))
        yield from (published, dropped)

    def _limits(self) -> Iterator[Metric]:
        labels = ["what"]
        families: list[GaugeMetricFamily | CounterMetricFamily] = [
            GaugeMetricFamily("spiked_concurrent", "Operations in progress.", labels=labels),
            GaugeMetricFamily("spiked_concurrent_limit", "Most operations at a time.", labels=labels),
            CounterMetricFamily("spiked_rejected", "Operations rejected at the limit.", labels=labels),
            # The names of 0.1, kept for one release.
            GaugeMetricFamily("spiked_inside", "Deprecated: use spiked_concurrent.", labels=labels),
            GaugeMetricFamily("spiked_inside_limit", "Deprecated: use spiked_concurrent_limit.", labels=labels),
            CounterMetricFamily("spiked_refused", "Deprecated: use spiked_rejected_total.", labels=labels),
        ]
        for what, limit in self._concurrency.items():
            for family, value in zip(families, 2 * (limit.active, limit.limit, limit.rejected), strict=True):
                family.add_metric([what], value)
        yield from families


def _states(name: str, text: str, counts: dict[str, int], label: str = "state") -> Metric:
    family = GaugeMetricFamily(name, text, labels=[label])
    for state, count in counts.items():
        family.add_metric([state], count)
    return family


def _disk(folder: Path) -> Iterator[Metric]:
    stat = os.statvfs(folder)
    yield GaugeMetricFamily(
        "spiked_disk_free_bytes", "Free space on the disk of the data folder.", stat.f_bavail * stat.f_frsize
    )
    yield GaugeMetricFamily("spiked_disk_bytes", "Size of the disk of the data folder.", stat.f_blocks * stat.f_frsize)


def _build() -> dict[str, str]:
    return {
        "version": installed_version(),
        "python": platform.python_version(),
        "machine": platform.machine(),
        "instruction_set": instruction_sets()[0],
    }
