"""Metrics: totals over captures, and what a running daemon exposes."""

import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
from prometheus_client.parser import text_string_to_metric_families
from spiked_service.base.health import CheckStatus, Health
from spiked_service.base.limits import ConcurrencyLimit
from spiked_service.events.bus import Bus, Topic
from spiked_service.events.payloads import PosePayload
from spiked_service.operations.metrics import Metrics, MetricsSource, RingSample
from spiked_service.store.rows import CaptureState, ConsumerCounters, Counters, Grade
from waiting import until

from spiked.ring import DeviceState, Policy

from .survival import SMALL


def counters(received: int, lost: int = 0) -> Counters:
    recorder = ConsumerCounters("recorder", Policy.PRIORITY, received, lost, 16, 0.25, False)
    return Counters(DeviceState.STREAMING, "", received, {"usb": lost}, received + lost, (recorder,))


class Scraped:
    """A service's figures by name and labels."""

    def __init__(self, text: str) -> None:
        self.families = {family.name: family for family in text_string_to_metric_families(text)}
        self.samples = {
            (sample.name, tuple(sorted(sample.labels.items()))): sample.value
            for family in self.families.values()
            for sample in family.samples
        }

    def __call__(self, name: str, **labels: str) -> float:
        return self.samples[name, tuple(sorted(labels.items()))]


def scraped(metrics: Metrics) -> Scraped:
    return Scraped(metrics.exposition().decode())


def made(samples: list[RingSample], bus: Bus | None = None, health: Health | None = None) -> Metrics:
    return Metrics(
        MetricsSource(
            lambda: list(samples), lambda: {"streaming": 1}, dict, lambda: {"queued": 2}, dict, lambda: Path("/")
        ),
        bus or Bus(),
        health or Health(),
        {"renders": ConcurrencyLimit("renders", 3), "event_clients": ConcurrencyLimit("event clients", 5)},
    )


def test_frames_add_up_over_captures_of_a_device() -> None:
    samples = [RingSample("a", "usb0", counters(100, 5), over=False)]
    metrics = made(samples)
    assert scraped(metrics)("spiked_frames_received_total", device="usb0") == 100
    samples[:] = [RingSample("a", "usb0", counters(150, 5), over=True)]
    assert scraped(metrics)("spiked_frames_received_total", device="usb0") == 150
    samples[:] = [RingSample("b", "usb0", counters(10), over=False)]
    now = scraped(metrics)
    assert now("spiked_frames_received_total", device="usb0") == 160
    assert now("spiked_frames_lost_total", device="usb0", cause="usb") == 5
    assert now("spiked_frames_lost_total", device="usb0", cause="disk") == 0
    assert now("spiked_consumer_frames_total", device="usb0", consumer="recorder") == 160
    assert now("spiked_ring_fill_ratio", device="usb0", consumer="recorder") == 0.25
    assert now("spiked_device_state", device="usb0", state="streaming") == 1
    assert now("spiked_device_state", device="usb0", state="lost") == 0


def test_scrapes_at_the_same_time_count_frames_once() -> None:
    """The last counters of a ring come once; a scrape that read older ones must not bring them afterwards."""
    ended = [RingSample("a", "usb0", counters(100, 5), over=True)]
    asked, go_on = threading.Event(), threading.Event()

    def rings() -> Iterator[RingSample]:
        samples, ended[:] = list(ended), []
        asked.set()
        go_on.wait(10)
        yield from samples

    source = MetricsSource(rings, dict, dict, dict, dict, lambda: Path("/"))
    metrics = Metrics(source, Bus(), Health(), {})
    first = threading.Thread(target=metrics.exposition)
    first.start()
    assert asked.wait(10)
    second = threading.Thread(target=metrics.exposition)
    second.start()
    go_on.set()
    first.join()
    second.join()
    assert scraped(metrics)("spiked_frames_received_total", device="usb0") == 100


def test_latency_of_poses_and_what_listeners_lost() -> None:
    bus = Bus()
    metrics = made([], bus)
    slow = bus.subscribe(capacity=1)
    for latency_s in (0.004, 0.04, None):
        pose = PosePayload(
            frame=1, time_s=0, position=(0, 0, 0), quaternion_wxyz=(1, 0, 0, 0), state="track", latency_s=latency_s
        )
        bus.publish(Topic.POSE, pose)
    now = scraped(metrics)
    assert now("spiked_pose_latency_seconds_count") == 2
    assert now("spiked_pose_latency_seconds_bucket", le="0.005") == 1
    assert now("spiked_events_published_total", topic="pose") == 3
    assert now("spiked_events_dropped_total", topic="pose") == 2
    slow.close()
    assert scraped(metrics)("spiked_events_dropped_total", topic="pose") == 2


def test_states_limits_and_checks() -> None:
    health = Health()
    health.add("disk", lambda: (CheckStatus.FAILED, "full"))
    now = scraped(made([], health=health))
    assert now("spiked_reconstructions", state="queued") == 2
    for name in ("spiked_concurrent_limit", "spiked_inside_limit"):  # the second is its deprecated name
        assert now(name, what="renders") == 3
    assert now("spiked_concurrent", what="renders") == now("spiked_inside", what="renders") == 0
    assert now("spiked_rejected_total", what="renders") == now("spiked_refused_total", what="renders") == 0
    assert now("spiked_check_failed", check="disk") == 1
    assert now("spiked_disk_free_bytes") > 0
    build = next(labels for name, labels in now.samples if name == "spiked_build_info")
    assert {name for name, _ in build} == {"version", "python", "machine", "instruction_set"}


def test_a_daemon_exposes_what_it_does(daemon: Callable[..., Any]) -> None:
    one = daemon()
    one.http.get("devices")
    one.http.get("captures/no-such")
    httpx.get(f"{one.address}nowhere")
    now = Scraped(httpx.get(f"{one.address}metrics").text)
    requests = "spiked_http_request_seconds_count"
    assert now(requests, method="GET", route="/api/v1/devices", status="200") == 1
    assert now(requests, method="GET", route="/api/v1/captures/{capture_id}", status="404") == 1
    assert now(requests, method="GET", route="other", status="404") == 1
    assert now("process_resident_memory_bytes") > 10e6
    assert now("spiked_check_failed", check="zmq") == 0


def test_failed_captures_and_degraded_recordings_are_counted_from_zero(daemon: Callable[..., Any]) -> None:
    """An alert on a change never fires for a series that begins with one."""
    one = daemon("--no-capture", "--device", f"{SMALL}&drop=0.01&drop_run=5", "--device", SMALL)

    def now() -> Scraped:
        return Scraped(httpx.get(f"{one.address}metrics").text)

    before = now()
    for grade in Grade:
        assert before("spiked_recordings", grade=grade) == 0
    for state in CaptureState:
        assert before("spiked_captures", state=state) == 0
    ids = []
    for options in ("&drop=0.01&drop_run=5", ""):
        body = {"device": SMALL + options, "frames": 4000, "reconstruct": False}
        ids.append(one.http.post("captures", json=body).raise_for_status().json()["id"])
        until(lambda: one.http.get(f"captures/{ids[-1]}").json()["verdict"], "its recording has been judged")
    after = now()
    assert after("spiked_recordings", grade="degraded") == 1 and after("spiked_recordings", grade="good") == 1
    assert after("spiked_recordings", grade="bad") == 0 and after("spiked_captures", state="failed") == 0
    one.http.delete(f"captures/{ids[0]}").raise_for_status()
    assert now()("spiked_recordings", grade="degraded") == 0, "a removed one is not counted"
