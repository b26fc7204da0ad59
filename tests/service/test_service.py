"""The daemon over HTTP, and what becomes of it when parts of it die."""

import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from http.client import HTTPConnection
from pathlib import Path
from select import select
from typing import Any

import httpx
import psutil
import pytest
from waiting import until

SHM = Path("/dev/shm")
ENDED_S = 20.0
SMALL = "sim:?width=96&height=64"
TRACKABLE = "sim:?width=160&height=100"
"""Large enough for a path, from `PATH_FRAMES` on."""
PATH_FRAMES = 600


def one_capture(daemon: Any) -> dict[str, Any]:
    (capture,) = daemon.http.get("captures").json()["items"]
    ids = capture["reconstruction_ids"]
    job = daemon.http.get(f"reconstructions/{ids[-1]}").json() if ids else None
    return {**capture, "reconstruction": job}


def streaming(daemon: Any) -> dict[str, Any]:
    """The capture, once its workers run, frames have come and its state says so."""

    def flows() -> bool:
        capture = one_capture(daemon)
        return capture["state"] == "streaming" and capture["counters"]["received"] > 100

    until(flows, "frames come")
    assert set(daemon.workers()) == {"acquisition", "recorder", "reconstruction", "preview"}
    return one_capture(daemon)


def ring_of(capture: dict[str, Any]) -> Path:
    return SHM / f"spiked-{capture['id']}"


def test_errors_are_problem_details(daemon: Callable[..., Any]) -> None:
    http = daemon().http
    answers = [
        (404, http.get("captures/no-such")),
        (404, http.get("nowhere")),
        (422, http.post("captures", json={"source": "sim:", "frames": 5, "seconds": 1})),
        (422, http.post("captures", json={})),
    ]
    for status, answer in answers:
        assert answer.status_code == status
        assert answer.headers["content-type"] == "application/problem+json"
        assert answer.json()["status"] == status
        assert answer.json()["detail"]


def test_pages_and_health(daemon: Callable[..., Any]) -> None:
    one = daemon("--device", "replay:rec.dat", "--no-capture")
    assert httpx.get(f"{one.address}healthz").json()["status"] == "ok"
    assert httpx.get(f"{one.address}readyz").status_code == 200
    assert "<title>spiked</title>" in httpx.get(one.address).text
    assert httpx.get(f"{one.address}docs", follow_redirects=True).status_code == 200
    examples = httpx.get(f"{one.address}openapi.json").json()["components"]["schemas"]["ViewRequest"]["examples"]
    assert len(examples) == 3
    assert [device["source"] for device in one.http.get("devices").json()["items"]][:2] == ["replay:rec.dat", "sim:"]


def test_an_idle_connection_outlives_the_pools_of_clients(daemon: Callable[..., Any]) -> None:
    """httpx uses one again for 5 s: closed after 5 s, too, a request at that moment got no answer."""
    one = daemon("--device", "replay:rec.dat", "--no-capture")
    with closing(HTTPConnection("127.0.0.1", httpx.URL(one.address).port, timeout=20)) as kept:
        kept.request("GET", "/healthz")
        assert kept.getresponse().read()
        assert kept.sock is not None
        closed, _, _ = select([kept.sock], [], [], 6.0)
        assert not closed


def test_a_token_is_asked_for_and_taken_in_three_ways(daemon: Callable[..., Any]) -> None:
    one = daemon("--token", "sesame", token="sesame")
    assert one.http.get("captures").status_code == 200
    refused = httpx.get(f"{one.address}api/v1/captures")
    assert refused.status_code == 401
    assert refused.headers["content-type"] == "application/problem+json"
    assert httpx.get(f"{one.address}api/v1/captures", headers={"Authorization": "Bearer open"}).status_code == 401
    assert httpx.get(f"{one.address}healthz").status_code == 200
    with httpx.Client() as browser:
        opened = browser.get(f"{one.address}?token=sesame", follow_redirects=True)
        assert (opened.status_code, opened.url.query) == (200, b"")
        assert browser.get(f"{one.address}api/v1/captures").status_code == 200


@pytest.mark.parametrize("source", ["usb:", "foo:", "sim:?bogus=1", "sim:?pace=abc", "replay:none.dat"])
def test_a_source_that_cannot_be_opened_is_refused_at_once(daemon: Callable[..., Any], source: str) -> None:
    one = daemon()
    answer = one.http.post("captures", json={"source": source})
    assert answer.status_code == 422
    assert answer.headers["content-type"] == "application/problem+json"
    assert source.partition("?")[0].removeprefix("replay:") in answer.json()["detail"]
    assert one.http.get("captures").json()["items"] == []


def test_a_camera_that_is_not_plugged_in_is_waited_for(daemon: Callable[..., Any]) -> None:
    one = daemon("--device", "usb7", "--follow")
    capture = f"captures/{one_capture(one)['id']}"
    waits = "the camera usb7 is not there: waiting for it"

    def told() -> bool:
        counters = one.http.get(capture).json()["counters"] or {"device": None}
        return counters["device"] == "absent" and counters["device_reason"] == waits

    until(told, "it is said that the camera is not there")
    until(lambda: one.output.readline() == f"waiting  {waits}\n", "whoever follows is told")
    assert one.http.get(capture).json()["reason"] == one.http.get("captures").json()["items"][0]["reason"] == waits
    one.http.post(f"{capture}:stop")
    until(lambda: one.http.get(capture).json()["state"] in ("complete", "failed"), "it can be stopped all the same")
    over = one.http.get(capture).json()
    assert (over["state"], over["reason"]) == ("complete", "no frames: the camera was absent")


def test_serving_a_device_that_cannot_be_opened_ends_with_one_line(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "spiked_service", "serve", "--port", "0", "--runtime", str(tmp_path / "runtime")]
    command += ["--data", str(tmp_path / "data")]
    done = subprocess.run(
        [*command, "--device", f"replay:{tmp_path / 'none.dat'}"],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 2
    assert done.stderr.startswith("error: ") and "none.dat" in done.stderr and done.stderr.count("\n") == 1


def test_when_acquisition_and_recorder_die_together_what_came_is_kept_and_reconstructed(
    daemon: Callable[..., Any],
) -> None:
    one = daemon()
    started = one.http.post("captures", json={"source": f"{SMALL}&pace=1", "options": {"steps": 5}}).json()

    def capture() -> dict[str, Any]:
        return dict(one.http.get(f"captures/{started['id']}").json())

    until(lambda: bool(capture()["counters"]) and capture()["counters"]["received"] > 600, "frames come")
    workers = one.workers()
    workers["recorder"].suspend()  # a process can be killed at any moment: here before it sees the other's death
    workers["acquisition"].kill()
    until(lambda: "acquisition" not in one.workers(), "its death is seen")
    workers["recorder"].kill()
    until(lambda: capture()["state"] == "failed", "the capture has failed")
    kept = capture()
    assert kept["verdict"]["grade"] == "degraded"
    assert (kept["recording"]["frames"], kept["recording"]["lost"]) == (kept["counters"]["next_frame"], 0)
    assert kept["verdict"]["reasons"] == ["the acquisition died"]
    assert not ring_of(kept).exists()

    def jobs() -> list[dict[str, Any]]:
        return list(one.http.get("reconstructions").json()["items"])

    until(lambda: all(job["state"] in ("complete", "failed") for job in jobs()), "no job waits for ever")


def test_one_capture_at_a_time_and_the_account_of_frames(daemon: Callable[..., Any]) -> None:
    one = daemon()
    started = one.http.post("captures", json={"source": SMALL, "frames": 400, "options": {"steps": 10}})
    assert started.status_code == 201
    assert started.headers["location"].endswith(started.json()["id"])
    assert one.http.post("captures", json={"source": SMALL}).status_code == 409
    until(lambda: one_capture(one)["state"] in ("complete", "failed"), "the capture ends")
    capture = one_capture(one)
    assert (capture["state"], capture["reason"]) == ("complete", "")
    assert capture["counters"]["received"] == capture["counters"]["next_frame"] == 400
    assert capture["reconstruction"]["frames"] == 400
    assert one.http.get(f"captures/{capture['id']}/preview?format=webp").content.startswith(b"RIFF")
    assert not ring_of(capture).exists()
    assert one.workers() == {}


@pytest.mark.slow
def test_stop_ends_the_source_and_then_the_reconstruction(daemon: Callable[..., Any]) -> None:
    one = daemon("--device", "sim:")
    capture = streaming(one)
    until(lambda: one_capture(one)["reconstruction"]["version"] > 0, "there is a map to refine")
    assert one.http.post(f"captures/{capture['id']}:stop").status_code == 202
    until(lambda: one_capture(one)["state"] == "finishing", "the source ends")
    one.http.post(f"captures/{capture['id']}:stop")
    until(lambda: one_capture(one)["state"] == "complete", "the reconstruction ends")
    assert one_capture(one)["reconstruction"]["progress"] < 1
    assert one.workers() == {}


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_everything_and_leaves_nothing(
    daemon: Callable[..., Any], tmp_path: Path, number: signal.Signals
) -> None:
    one = daemon("--device", SMALL)
    capture = streaming(one)
    workers = list(one.workers().values())
    one.process.send_signal(number)
    assert one.process.wait(ENDED_S) == 0
    assert psutil.wait_procs(workers, ENDED_S)[1] == []
    assert not ring_of(capture).exists()
    assert list((tmp_path / "runtime").iterdir()) == []


INTERRUPTED = """
import os, signal, sys
from pydantic import BaseModel
from spiked_service.daemon import Daemon
from spiked_service.events.bus import Topic
from spiked_service.settings.reload import ReloadableSettings

class Interrupting(BaseModel):
    @property
    def id(self):  # read by the bus under its lock, on this thread; the handler logs, and a log line is a message
        os.kill(os.getpid(), signal.SIGTERM)
        for _ in range(1000):
            pass  # the handler runs in between
        return "interrupting"

with Daemon(ReloadableSettings({"port": 0, "data": sys.argv[1] + "/data", "runtime": sys.argv[1] + "/run"})) as daemon:
    async def strike():
        daemon.services.bus.publish(Topic.DEVICE, Interrupting())
    daemon.heartbeat.beat = strike
    daemon.run()
"""


def test_a_signal_under_a_lock_of_the_events_ends_the_service_all_the_same(tmp_path: Path) -> None:
    ended = subprocess.run([sys.executable, "-c", INTERRUPTED, tmp_path], timeout=60, check=False, capture_output=True)
    assert ended.returncode == 0, ended.stderr.decode()
    assert b"stopping" in ended.stderr


def test_the_death_of_the_service_takes_all_workers_along(daemon: Callable[..., Any], tmp_path: Path) -> None:
    one = daemon("--device", SMALL)
    capture = streaming(one)
    workers = list(one.workers().values())
    one.process.kill()
    assert psutil.wait_procs(workers, ENDED_S)[1] == []
    one.process.wait()
    abandoned = list((tmp_path / "runtime").iterdir())
    assert len(abandoned) == 1
    daemon()
    assert not ring_of(capture).exists()
    assert not abandoned[0].exists()


def test_the_death_of_the_acquisition_is_told_and_its_ring_removed(daemon: Callable[..., Any]) -> None:
    one = daemon("--device", SMALL)
    capture = streaming(one)
    one.workers()["acquisition"].kill()
    until(lambda: one_capture(one)["reason"] != "", "the death is told")
    assert one_capture(one)["reason"] == "the acquisition worker was killed by signal 9"
    until(lambda: not ring_of(capture).exists(), "the ring is gone")
    one.http.post(f"captures/{capture['id']}:stop")
    until(lambda: one_capture(one)["state"] == "failed", "the reconstruction ends with what there is")
    assert one.workers() == {}


def test_the_death_of_the_reconstruction_leaves_the_recording_and_begins_again_from_it(
    daemon: Callable[..., Any],
) -> None:
    one = daemon()
    one.http.post("captures", json={"source": TRACKABLE, "options": {"steps": 10}})
    capture = streaming(one)
    one.workers()["reconstruction"].kill()
    until(lambda: one_capture(one)["warnings"] != [], "the death is told")
    assert one_capture(one)["warnings"][0].startswith("the reconstruction worker was killed by signal 9; restarted")
    before = one_capture(one)["counters"]["received"]
    until(lambda: one_capture(one)["counters"]["received"] > before + PATH_FRAMES, "frames still arrive")
    one.http.post(f"captures/{capture['id']}:stop")
    until(lambda: one_capture(one)["state"] == "complete", "the capture ends well")
    assert one_capture(one)["verdict"]["grade"] == "good"
    until(lambda: one_capture(one)["reconstruction"]["ended_at"] is not None, "its reconstruction ends")
    reconstruction = one_capture(one)["reconstruction"]
    assert reconstruction["state"] == "complete", reconstruction["reason"]
    assert one_capture(one)["reconstruction"]["frames"] == one_capture(one)["recording"]["frames"]
    assert one.workers() == {}
    assert not ring_of(capture).exists()


def test_the_death_of_the_preview_is_mended(daemon: Callable[..., Any]) -> None:
    one = daemon("--device", SMALL)
    streaming(one)
    dead = one.workers()["preview"]
    dead.kill()
    until(lambda: one.workers().get("preview", dead).pid != dead.pid, "another preview runs")
    capture = one_capture(one)
    assert capture["state"] == "streaming"
    assert capture["warnings"] == ["the preview worker was killed by signal 9; it was restarted"]
