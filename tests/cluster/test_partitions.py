"""Machines that are cut off: agents in a network namespace, with a cable to the service and one to the store."""

import json
import os
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import httpx
import psutil
import pytest
from faulty_proxy import FaultyProxy
from namespace_machine import Machine
from ports import free_port
from spiked_service.cluster.cluster import Cluster
from spiked_service.cluster.engine import EngineOptions
from spiked_service.cluster.object_store import ObjectStore
from spiked_service.cluster.remote_worker import Terms
from spiked_service.results.versions import newest, versions
from waiting import until

from .lab import LOCALLY, SHORT_LEASE_S, Lab, complete

pytest.importorskip("submitit")

LONG_LEASE_S = 30.0
MANY_STEPS = {"steps": 3000}


@pytest.fixture
def machine(scratch: Path) -> Iterator[Machine]:
    if not Machine.possible():
        pytest.skip("needs root and iproute2, to make a network namespace")
    with Machine() as one:
        yield one
        for process in psutil.process_iter():
            with suppress(psutil.Error):
                if process.environ().get("SPIKED_SCRATCH") == str(scratch):
                    process.kill()


@pytest.fixture
def elsewhere(
    bucket: str, machine: Machine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[dict[str, Any]]:
    """The agents of the lab are in the namespace."""
    port, store_port = free_port(), int(os.environ["AWS_ENDPOINT_URL"].rpartition(":")[2])
    with (
        FaultyProxy(port, host=machine.to_service.here) as service,
        FaultyProxy(store_port, host=machine.to_store.here) as store,
    ):
        for name, value in machine.for_agents(tmp_path).items():
            monkeypatch.setenv(name, value)
        monkeypatch.setenv("AWS_ENDPOINT_URL", store.url)
        engine = LOCALLY | {"executor_url": service.url}
        yield {"store": f"{bucket}/{machine.name}", "engine": engine, "port": port}


def published(lab: Lab, job: str, after: int = 0) -> int:
    return int(lab.reached(job, lambda row: row["version"] > after, "it publishes")["version"])


def attempts(lab: Lab, job: str) -> int:
    return int(json.loads((lab.folder(job) / "reconstruction.json").read_text())["attempts"])


def finished(lab: Lab, job: str) -> None:
    """Wait for the end of the refinement, and look whether the job is done once and whole."""
    row = lab.reached(job, complete, "it is complete")
    last = newest(lab.folder(job))
    assert last is not None and row["version"] == last.version
    numbers = [one.version for one in versions(lab.folder(job))]
    assert numbers == sorted(set(numbers))
    for one in versions(lab.folder(job)):
        assert (lab.folder(job) / one.scene).stat().st_size == one.scene_bytes


@pytest.mark.parametrize("lab", [SHORT_LEASE_S], indirect=True)
def test_a_machine_that_is_cut_off_for_longer_than_the_lease_is_fenced_off(
    lab: Lab, machine: Machine, bucket: str
) -> None:
    job = lab.submit(MANY_STEPS)
    version, attempt, worker = published(lab, job), lab.attempt(job), lab.workers()[0]
    machine.to_service.pull_out()
    until(lambda: not worker.is_running() or worker.status() == psutil.STATUS_ZOMBIE, "its worker has ended")
    lab.reached(job, lambda row: lab.attempt(job) not in ("", attempt), "another attempt has begun")
    assert lab.job(job)["version"] >= version, "what was published stays"
    machine.to_service.plug_in()
    token = Cluster(Path(lab.one.data) / "cluster", bucket, EngineOptions("submitit", 1, 0), Terms(1)).token(attempt)
    for route, told in (("begin", {"node": "n"}), ("report", {}), ("end", {})):
        answer = httpx.post(
            f"{lab.one.address}api/v1/attempts/{attempt}:{route}",
            json={"agent": "a"} | told,
            headers={"Authorization": f"Bearer {token}"},
        )
        assert answer.status_code == 410, "it is refused whatever it brings"
    (service,) = ObjectStore(f"{bucket}/{machine.name}").folders()
    stored = ObjectStore(f"{bucket}/{machine.name}").below(service, job)
    until(lambda: attempt not in stored.folders(), "what it has stored is swept")
    finished(lab, job)
    assert attempts(lab, job) == 2
    until(lambda: not stored.folders(), "nothing is left in the store")


@pytest.mark.parametrize("lab", [LONG_LEASE_S], indirect=True)
def test_a_machine_that_is_cut_off_for_less_than_the_lease_goes_on(lab: Lab, machine: Machine) -> None:
    job = lab.submit(MANY_STEPS)
    published(lab, job)
    machine.to_service.pull_out()
    time.sleep(LONG_LEASE_S / 3)
    machine.to_service.plug_in()
    finished(lab, job)
    assert attempts(lab, job) == 1


@pytest.mark.parametrize("lab", [SHORT_LEASE_S], indirect=True)
def test_a_machine_that_is_cut_off_from_the_store_keeps_its_lease(lab: Lab, machine: Machine) -> None:
    job = lab.submit(MANY_STEPS)
    published(lab, job)
    attempt = lab.attempt(job)
    machine.to_store.pull_out()
    time.sleep(3 * SHORT_LEASE_S)
    assert lab.attempt(job) == attempt and lab.job(job)["state"] == "running"
    machine.to_store.plug_in()
    finished(lab, job)
    assert attempts(lab, job) == 1
