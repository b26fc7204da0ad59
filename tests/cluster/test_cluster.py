"""Jobs on other machines, with submitit's local executor: agents are real processes, files go through a real store."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import httpx
import psutil
import pytest
from namespace_machine import Machine
from spiked_service.cluster.cluster import Cluster
from spiked_service.cluster.engine import EngineOptions
from spiked_service.cluster.object_store import ObjectStore
from spiked_service.cluster.remote_worker import Terms
from spiked_service.results.versions import newest, versions
from waiting import until

from .lab import LEASE_S, LONG, SHORT, SHORT_LEASE_S, Lab, complete

pytest.importorskip("submitit")


@pytest.fixture
def far_lab(
    daemon: Callable[..., Any],
    moving: Path,
    bucket: str,
    scratch: Path,
) -> Lab:
    """A lab whose machines share no folder with it, but a bucket."""
    return Lab(daemon, moving, scratch, LEASE_S, f"{bucket}/far-lab")


def test_jobs_elsewhere_end_as_those_here(lab: Lab) -> None:
    jobs = [lab.submit(SHORT) for _ in range(3)]
    for job in jobs:
        row = lab.reached(job, complete, "it is complete")
        assert row["node"] == socket.gethostname()
        published = newest(lab.folder(job))
        assert published is not None and published.version == row["version"] > 0 and row["poses"] == 500
        for one in versions(lab.folder(job)):
            assert (lab.folder(job) / one.scene).stat().st_size == one.scene_bytes
        assert len(lab.get(f"reconstructions/{job}/versions")["items"]) == len(versions(lab.folder(job)))
        assert lab.get(f"reconstructions/{job}/timeline")["work"]["work_s"]
        assert lab.attempt(job) == ""
    until(lab.nothing_left, "nothing is left of the attempts")


def test_an_agent_goes_on_with_the_next_job(lab: Lab) -> None:
    jobs = [lab.submit(SHORT) for _ in range(8)]
    for job in jobs:
        lab.reached(job, complete, "it is complete")
    logs = [lab.log(job) for job in jobs]
    numbers = [int(log.rpartition("attempt ")[2].partition(" of its agent")[0]) for log in logs]
    assert max(numbers) > 1 and numbers.count(1) < len(jobs), f"an agent a job: {numbers}"
    until(lab.nothing_left, "nothing is left of the attempts")


def test_many_jobs_of_a_recording_send_and_fetch_it_once(far_lab: Lab, bucket: str) -> None:
    lab = far_lab
    lab.reached(lab.submit(SHORT), complete, "the first one is complete")
    (service,) = (ObjectStore(f"{bucket}/far-lab").below(name) for name in ObjectStore(f"{bucket}/far-lab").folders())
    recordings = service.below("recordings")
    names = recordings.objects()
    (cache,) = lab.scratch.glob("spiked-recordings-*")
    assert {path.name for path in cache.iterdir() if path.suffix != ".lock"} == set(names)
    sizes = {name: (cache / name).stat().st_size for name in names}
    assert max(sizes.values()) == lab.get(f"captures/{lab.capture}")["recording"]["bytes"]
    for name, size in sizes.items():  # whoever fetched them again would notice
        recordings.put(name, b"x" * size)
    for job in [lab.submit(SHORT) for _ in range(3)]:
        row = lab.reached(job, complete, "it is complete")
        assert row["poses"] == 500 and row["reason"] == ""
    assert all(recordings.get(name) == b"x" * size for name, size in sizes.items()), "nor is it sent again"
    until(lambda: service.folders() == ["recordings"], "nothing is left of the attempts in the store")
    until(lambda: list(lab.scratch.iterdir()) == [cache], "nor on the machine")


def test_a_killed_agent_or_worker_costs_an_attempt_and_nothing_else(lab: Lab) -> None:
    first, second = lab.submit(LONG), lab.submit(LONG)
    for job in (first, second):
        lab.reached(job, lambda row: row["version"] > 0, "it has published")
    before = {job: (lab.job(job)["version"], lab.attempt(job)) for job in (first, second)}
    agent, other = lab.agents()
    worker = next(one for one in lab.workers() if lab.agent_of(one) == other.pid)
    agent.kill()
    worker.kill()
    reasons: list[str] = []
    for job in (first, second):
        lab.reached(job, lambda row, job=job: lab.attempt(job) not in ("", before[job][1]), "another attempt has begun")
        row = lab.reached(job, lambda row, job=job: row["version"] > before[job][0], "it publishes again")
        assert row["state"] == "running"
        log = lab.log(job).splitlines()
        begins = [line for line in log if line.endswith(f" on {socket.gethostname()} ==")]
        assert begins == [
            f"== attempt {one} on {socket.gethostname()} ==" for one in (before[job][1], lab.attempt(job))
        ]
        reasons += [line for line in log if line.startswith(f"== attempt {before[job][1]} has ended: ")]
        assert [one["version"] for one in lab.get(f"reconstructions/{job}/versions")["items"]][:1] == [1]
    assert sorted("killed by signal 9" in reason for reason in reasons) == [False, True]
    for job in (first, second):
        lab.post(f"reconstructions/{job}:cancel")
        lab.reached(job, lambda row: row["state"] == "cancelled", "it is cancelled")
    until(lab.nothing_left, "nothing is left of the attempts")


def test_another_attempt_goes_on_from_the_checkpoint_of_the_one_before(lab: Lab) -> None:
    killed, held = lab.submit(LONG), lab.submit(LONG)
    for job in (killed, held):
        until(lambda job=job: list(lab.store().glob(f"*/{job}/*/checkpoint.json")), "a checkpoint is stored")
    attempts = {job: lab.attempt(job) for job in (killed, held)}
    assert lab.one.http.patch(f"reconstructions/{held}", json={"held": True}).is_success
    lab.reached(held, lambda row: row["state"] == "queued", "it is held")
    assert lab.one.http.patch(f"reconstructions/{held}", json={"held": False}).is_success
    for agent in lab.agents():
        agent.kill()
    for job in (killed, held):
        lab.reached(job, lambda row, job=job: lab.attempt(job) not in ("", attempts[job]), "another attempt has begun")
        lab.reached(job, lambda row: row["version"] > 0 and row["stage"] == "refining", "it refines")
        until(lambda job=job: "resumed from its checkpoint" in lab.log(job), "it goes on where it was")
    for job in (killed, held):
        lab.post(f"reconstructions/{job}:cancel")
        lab.reached(job, lambda row: row["state"] == "cancelled", "it is cancelled")
        assert not (lab.folder(job) / "checkpoint").exists()
    until(lab.nothing_left, "nothing is left of the attempts")


def test_a_restart_of_the_service_costs_no_attempt(lab: Lab) -> None:
    job = lab.submit(LONG)
    lab.reached(job, lambda row: row["version"] > 0, "it has published")
    attempt = lab.attempt(job)
    lab.one.process.send_signal(signal.SIGKILL)
    lab.one.process.wait()
    lab.start()
    assert lab.job(job)["state"] == "running"
    version = lab.job(job)["version"]
    row = lab.reached(job, lambda row: row["version"] > version, "it publishes again")
    assert (row["state"], lab.attempt(job)) == ("running", attempt)
    lab.one.close()  # an orderly end leaves it alone, too
    assert lab.workers()
    lab.start()
    lab.reached(job, lambda row: row["version"] > version + 1, "it publishes again")
    assert lab.attempt(job) == attempt


@pytest.mark.parametrize("lab", [SHORT_LEASE_S], indirect=True)
def test_what_ends_while_the_service_is_down_is_taken_at_its_start(lab: Lab) -> None:
    job = lab.submit(SHORT)
    until(lab.workers, "its worker runs")
    lab.one.process.kill()
    lab.one.process.wait()
    until(lambda: not lab.agents(), "the agent has given up")
    kept = list(lab.store().glob(f"*/{job}/*/manifest.json"))
    lab.start()
    row = lab.reached(job, complete, "it is complete")
    published = newest(lab.folder(job))
    assert published is not None and row["version"] == published.version
    if kept:  # it was done within the lease
        assert json.loads((lab.folder(job) / "reconstruction.json").read_text())["attempts"] == 1
    until(lab.nothing_left, "nothing is left of the attempts")


@pytest.mark.parametrize("lab", [SHORT_LEASE_S], indirect=True)
def test_a_silent_agent_is_fenced_off(lab: Lab) -> None:
    job = lab.submit(LONG)
    lab.reached(job, lambda row: row["version"] > 0, "it has published")
    attempt, agent, worker = lab.attempt(job), lab.agents()[0], lab.workers()[0]
    agent.suspend()
    lab.reached(job, lambda row: lab.attempt(job) not in ("", attempt), "another attempt has begun")
    lab.reached(job, lambda row: row["node"] != "" and len(lab.workers()) > 0, "it runs again")
    with suppress(psutil.NoSuchProcess):
        agent.resume()
    until(lambda: not worker.is_running() or worker.status() == psutil.STATUS_ZOMBIE, "the old worker has ended")
    assert lab.job(job)["state"] == "running"


def test_what_an_agent_stores_after_its_job_has_ended_is_swept(lab: Lab) -> None:
    job, going_on = lab.submit(LONG), lab.submit(LONG)
    for one in (job, going_on):
        lab.reached(one, lambda row: row["version"] > 0, "it has published")
    (late,) = lab.store().glob(f"*/{job}/{lab.attempt(job)}")
    (alive,) = lab.store().glob(f"*/{going_on}/{lab.attempt(going_on)}")
    lab.post(f"reconstructions/{job}:cancel")
    lab.reached(job, lambda row: row["state"] == "cancelled", "it is cancelled")
    until(lambda: not late.exists(), "its files are removed")
    (late / "outputs").mkdir(parents=True)
    (late / "outputs" / "f00d").write_text("stored by an agent that was asleep")
    lab.reached(lab.submit(SHORT), complete, "another job has ended")
    until(lambda: not late.exists(), "it is swept when a job ends")
    (late / "outputs").mkdir(parents=True)
    (late / "outputs" / "f00d").write_text("stored while the service was away")
    lab.one.close()
    lab.start()
    until(lambda: not late.exists(), "it is swept at the start of the service")
    assert any((alive / "outputs").iterdir()), "what a living attempt has stored is left alone"
    version = lab.job(going_on)["version"]
    lab.reached(going_on, lambda row: row["version"] > version, "it goes on")
    lab.post(f"reconstructions/{going_on}:cancel")
    lab.reached(going_on, lambda row: row["state"] == "cancelled", "it is cancelled")
    until(lab.nothing_left, "nothing is left of the attempts")


def test_a_job_that_is_cancelled_is_gone_within_ten_seconds(lab: Lab) -> None:
    job, waiting = lab.submit(LONG), lab.submit(LONG)
    lab.reached(job, lambda row: row["stage"] == "refining", "it refines")
    begun = time.monotonic()
    for one in (job, waiting):
        lab.post(f"reconstructions/{one}:cancel")
        row = lab.reached(one, lambda row: row["state"] != "running", "it has ended")
        assert row["state"] == "cancelled"
    until(lab.nothing_left, "nothing is left of the attempts")
    assert lab.job(job)["version"] > 0
    assert time.monotonic() - begun < 120, "leases and graces are long over"


def test_agents_without_the_token_of_a_living_attempt_are_refused(lab: Lab) -> None:
    job = lab.submit(LONG)
    lab.reached(job, lambda row: row["version"] > 0, "it has published")
    attempt = lab.attempt(job)
    folder = Path(lab.one.data) / "cluster"
    engine = EngineOptions("submitit", 1, 0)
    token = Cluster(folder, (folder / "jobs").as_uri(), engine, Terms(LEASE_S)).token(attempt)
    http = httpx.Client(base_url=f"{lab.one.address}api/v1/attempts")

    def post(route: str, given: str, **body: object) -> httpx.Response:
        return http.post(route, json=body, headers={"Authorization": f"Bearer {given}"})

    assert post(f"/{attempt}:report", "guess", agent="a").status_code == 410
    assert post(f"/{attempt}:begin", token, agent="another", node="n").status_code == 410
    assert post(f"/{attempt}:report", token, agent="another").status_code == 410
    assert post(f"/{attempt}:end", token, agent="another").status_code == 410
    assert post(f"/{attempt}:next", token, agent="another").status_code == 410, "it has not ended this attempt"
    assert post(f"/{attempt}:report", token, agent="a", files=[{"name": "../x"}]).status_code == 422
    assert post(f"/{attempt}:report", token).status_code == 422
    assert post(f"/{job}:report", token, agent="a").status_code == 410, "the token of another"
    assert lab.job(job)["state"] == "running"
    lab.post(f"reconstructions/{job}:cancel")
    lab.reached(job, lambda row: row["state"] == "cancelled", "it is cancelled")
    assert post(f"/{attempt}:report", token, agent="a").status_code == 410, "it is over"


def test_a_service_whose_jobs_run_here_refuses_agents(daemon: Callable[..., Any]) -> None:
    attempt = "01928f5c-7e2a-7c3d-8a41-0f6d2b9c5e10"
    one = daemon()
    assert one.http.post(f"attempts/{attempt}:report", json={"agent": "a"}).status_code == 401
    headers = {"Authorization": "Bearer guess"}
    answer = one.http.post(f"attempts/{attempt}:report", json={"agent": "a"}, headers=headers)
    assert answer.status_code == 410
    assert answer.json()["what_to_do"]


def test_a_killed_engine_costs_no_attempt_that_has_begun(lab: Lab) -> None:
    job = lab.submit(LONG)
    row = lab.reached(job, lambda row: row["version"] > 0, "it has published")
    attempt = lab.attempt(job)
    (engine,) = lab.processes("spiked_service.cluster.engines")
    engine.kill()
    lab.reached(job, lambda now: now["version"] > row["version"], "it publishes again")
    other = lab.submit(SHORT)
    lab.reached(other, complete, "another one runs by a new engine")
    assert lab.attempt(job) == attempt
    lab.post(f"reconstructions/{job}:cancel")
    lab.reached(job, lambda now: now["state"] == "cancelled", "it is cancelled")
    until(lab.nothing_left, "nothing is left, though the new engine does not know it")
    folders = Path(lab.one.data) / "cluster" / "submitit"
    until(lambda: len(list(folders.glob("[0-9]*"))) == 1, "only the folder of the first engine's agent is left")
    old = folders / "1"
    old.mkdir()
    os.utime(old, (0, 0))
    (engine,) = lab.processes("spiked_service.cluster.engines")
    engine.kill()
    lab.reached(lab.submit(SHORT), complete, "one runs by a third engine")
    until(lambda: not list(folders.glob("[0-9]*")), "the folders of jobs that have ended are removed")


def test_a_job_waits_for_as_long_as_its_engine_dies(lab: Lab) -> None:
    job = lab.submit(SHORT)
    for _ in range(7):  # more often than a job is attempted
        (engine,) = until(lambda: lab.processes("spiked_service.cluster.engines"), "an engine starts")
        engine.kill()
        lab.reached(job, lambda row: row["state"] == "queued", "the job waits")
        assert "the engine submitit has ended" in lab.job(job)["reason"]
    lab.reached(job, complete, "it is complete")
    assert json.loads((lab.folder(job) / "reconstruction.json").read_text())["attempts"] == 1
    until(lab.nothing_left, "nothing is left of the attempts")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("executor", "more"),
    [
        ("submitit", []),
        ("ray", []),
        ("submitit", ["--store", "s3-moto", "--store-faults", "0.03", "--partitions"]),
        ("ray", ["--store", "s3-moto", "--store-faults", "0.03", "--partitions"]),
    ],
)
def test_jobs_outlive_random_kills(executor: str, more: list[str]) -> None:
    if executor == "ray":
        pytest.importorskip("ray")
    if "--partitions" in more and not Machine.possible():
        pytest.skip("needs root and iproute2, to make a network namespace")
    script = Path(__file__).parents[2] / "evaluation" / "measure_cluster.py"
    command = [sys.executable, str(script), executor, "--jobs", "40", "--kills", "15", "--every", "3", *more]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=550)
    assert done.returncode == 0, done.stdout + done.stderr[-3000:]
    report = json.loads(done.stdout)
    assert report["states"] == {"complete": 40} and sum(report["kills"].values()) > 5
    assert (report["left"]["left_in_store"], report["processes_left"]) == (0, 0)
