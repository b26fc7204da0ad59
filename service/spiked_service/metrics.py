"""Figures for Prometheus: what the rings count, what the service does, and how long it takes."""

import os
import platform
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from prometheus_client import CollectorRegistry, Histogram, ProcessCollector, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, InfoMetricFamily, Metric
from prometheus_client.registry import Collector

from spiked.blocks import instruction_sets
from spiked.ring import Cause, DeviceState
from spiked_service.commands.version import installed_version
from spiked_service.events import Bus, Message, Topic
from spiked_service.health import Health, Verdict
from spiked_service.limits import Gate
from spiked_service.payloads import PosePayload
from spiked_service.store.rows import Counters

_POSE_S = (0.002, 0.005, 0.01, 0.02, 0.03, 0.05, 0.075, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
_REQUEST_S = (0.002, 0.005, 0.01, 0.015, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 10.0)


@dataclass(frozen=True)
class Reading:
    """A capture at the moment of a scrape."""

    capture_id: str
    device: str
    """What it captures from, without options: a label must not grow with every capture."""
    counters: Counters
    over: bool
    """The counters are final."""


@dataclass(frozen=True)
class Readings:
    """Where the figures come from."""

    captures: Callable[[], Iterable[Reading]]
    """Running captures, and those that ended since the last time, once."""
    captures_by_state: Callable[[], dict[str, int]]
    reconstructions_by_state: Callable[[], dict[str, int]]
    workers_by_role: Callable[[], dict[str, int]]
    data: Callable[[], Path]
    """The data folder, or the nearest that exists above it."""


class Metrics:
    """All figures of one service, in a registry of their own."""

    def __init__(self, readings: Readings, bus: Bus, health: Health, renders: Gate, event_clients: Gate) -> None:
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
        self._registry.register(_Collector(readings, bus, health, renders, event_clients))
        bus.observe(self._see)

    def exposition(self) -> bytes:
        """Everything, in Prometheus' text format."""
        return generate_latest(self._registry)

    def _see(self, message: Message) -> None:
        if isinstance(message.payload, PosePayload) and message.payload.latency_s is not None:
            self.pose_latency_s.observe(message.payload.latency_s)


class _Totals:
    """Frames by device over all captures, though each capture counts from zero."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._seen: dict[str, Counter[tuple[str, ...]]] = {}
        self.totals: Counter[tuple[str, ...]] = Counter()

    def add(self, reading: Reading) -> None:
        """Take what has come since this capture was read last."""
        device, counters = reading.device, reading.counters
        now: Counter[tuple[str, ...]] = Counter({("received", device): counters.received})
        now.update({("lost", device, cause): count for cause, count in counters.lost.items()})
        for consumer in counters.consumers:
            now["taken", device, consumer.name] += consumer.received
            now["missed", device, consumer.name] += consumer.lost
        with self._lock:
            before = self._seen.get(reading.capture_id, Counter())
            for key, count in now.items():
                self.totals[key] += max(0, count - before[key])
            self._seen[reading.capture_id] = now
            if reading.over:
                del self._seen[reading.capture_id]


class _Collector(Collector):
    """Reads everything anew at each scrape."""

    def __init__(self, readings: Readings, bus: Bus, health: Health, renders: Gate, event_clients: Gate) -> None:
        self._readings = readings
        self._bus = bus
        self._health = health
        self._gates = {"renders": renders, "event_clients": event_clients}
        self._totals = _Totals()

    def describe(self) -> Iterable[Metric]:
        """Nothing in advance: registering must not read."""
        return ()

    def collect(self) -> Iterator[Metric]:
        """All families."""
        yield InfoMetricFamily("spiked_build", "What runs.", value=_build())
        yield from self._frames(list(self._readings.captures()))
        yield _states("spiked_captures", "Captures by state.", self._readings.captures_by_state())
        yield _states("spiked_reconstructions", "Jobs by state.", self._readings.reconstructions_by_state())
        yield _states("spiked_workers", "Worker processes.", self._readings.workers_by_role(), "role")
        yield from self._events()
        yield from self._limits()
        yield from _disk(self._readings.data())
        health = GaugeMetricFamily("spiked_check_failed", "1 where a check of readyz fails.", labels=["check"])
        for finding in self._health.readiness():
            health.add_metric([finding.name], float(finding.verdict is Verdict.FAILED))
        yield health

    def _frames(self, readings: list[Reading]) -> Iterator[Metric]:
        for reading in readings:
            self._totals.add(reading)
        live = [reading for reading in readings if not reading.over]
        device, consumer = ["device"], ["device", "consumer"]
        families = {
            "received": CounterMetricFamily("spiked_frames_received", "Frames that came into the ring.", labels=device),
            "lost": CounterMetricFamily(
                "spiked_frames_lost", "Frames that did not, by cause.", labels=["device", "cause"]
            ),
            "taken": CounterMetricFamily("spiked_consumer_frames", "Frames a consumer took.", labels=consumer),
            "missed": CounterMetricFamily(
                "spiked_consumer_frames_lost", "Frames a consumer was told are lost or skipped.", labels=consumer
            ),
        }
        totals = Counter(self._totals.totals)
        for reading in live:
            totals.update({("lost", reading.device, str(cause)): 0 for cause in Cause})
        for (kind, *labels), count in sorted(totals.items()):
            families[kind].add_metric(labels, count)
        yield from families.values()
        fill = GaugeMetricFamily("spiked_ring_fill_ratio", "A consumer's lag; at 1 it loses frames.", labels=consumer)
        lag = GaugeMetricFamily("spiked_consumer_lag_frames", "Frames a consumer is behind.", labels=consumer)
        lagging = GaugeMetricFamily("spiked_consumer_lagging", "1 while it has been overrun.", labels=consumer)
        state = GaugeMetricFamily("spiked_device_state", "1 for the state it is in.", labels=["device", "state"])
        for reading in live:
            for one in reading.counters.consumers:
                labels = [reading.device, one.name]
                fill.add_metric(labels, one.fill)
                lag.add_metric(labels, one.lag_frames)
                lagging.add_metric(labels, float(one.lagging))
            for each in DeviceState:
                state.add_metric([reading.device, each], float(each is reading.counters.device))
        yield from (fill, lag, lagging, state)

    def _events(self) -> Iterator[Metric]:
        published = CounterMetricFamily("spiked_events_published", "Messages on the bus.", labels=["topic"])
        dropped = CounterMetricFamily("spiked_events_dropped", "Messages slow clients lost.", labels=["topic"])
        told, lost = self._bus.published(), self._bus.dropped()
        for topic in Topic:
            if topic is not Topic.LOST:
                published.add_metric([topic], told.get(topic, 0))
                dropped.add_metric([topic], lost.get(topic, 0))
        yield from (published, dropped)

    def _limits(self) -> Iterator[Metric]:
        inside = GaugeMetricFamily("spiked_inside", "How many are at it now.", labels=["what"])
        most = GaugeMetricFamily("spiked_inside_limit", "How many may be.", labels=["what"])
        refused = CounterMetricFamily("spiked_refused", "How many were turned away.", labels=["what"])
        for what, gate in self._gates.items():
            inside.add_metric([what], gate.inside)
            most.add_metric([what], gate.limit)
            refused.add_metric([what], gate.refused)
        yield from (inside, most, refused)


def _states(name: str, text: str, counts: dict[str, int], label: str = "state") -> Metric:
    family = GaugeMetricFamily(name, text, labels=[label])
    for state, count in counts.items():
        family.add_metric([state], count)
    return family


def _disk(folder: Path) -> Iterator[Metric]:
    stat = os.statvfs(folder)
    yield GaugeMetricFamily("spiked_disk_free_bytes", "Below the data folder.", stat.f_bavail * stat.f_frsize)
    yield GaugeMetricFamily("spiked_disk_bytes", "Size of that disk.", stat.f_blocks * stat.f_frsize)


def _build() -> dict[str, str]:
    return {
        "version": installed_version(),
        "python": platform.python_version(),
        "machine": platform.machine(),
        "instruction_set": instruction_sets()[0],
    }
