"""Jobs on other machines under random kills: `python evaluation/measure_cluster.py ray --jobs 1000 --kills 200`.

Starts a service with an executor (and for Ray a head and two nodes on this machine), queues so many small jobs, and at
random moments kills a worker, an agent, a node of Ray, the engine's process or the service, which are started again.
`--store s3-moto` and `--store s3-swift` start a server of S3; with `--store-faults 0.05` one of twenty requests to it
is stalled, refused or truncated. With `--partitions`, as root, the second node, or all agents of submitit, are in a
network namespace, whose cables to the service and to the store are pulled out for times shorter and longer than the
lease; these are not counted as kills. Then it looks whether every job is complete, whether the files of every version
are there that is listed, and what is left in the store. All jobs are alike, and so are their results, which are
compared by hash. Prints one JSON object; the exit status is 1 if a job is lost or half. With `local` and no kills it is
the figure to compare with.
"""

import argparse
import hashlib
import json
import os
import random
import re
import subprocess
import sys
import tempfile
import time
from collections import Counter
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import httpx
import psutil

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests"))
from cluster_nodes import Partitions, RayNodes
from cluster_stores import SERVERS, Store, s3_store
from faulty_proxy import FaultyProxy
from namespace_machine import Machine
from ports import free_port
from spiked_service.results.versions import is_whole, versions

from spiked.recording import RecordingWriter
from spiked.sensor import Intrinsics, Sensor
from spiked.simulate import MotionKind, SimulatedCamera

LEASE_S = 10
START_S = 120.0
SWEPT_S = 60.0
"""Time after the last job for what is left to be swept: what still stalls must have failed, too."""


def recording(path: Path) -> None:
    """A small recording of a moving camera."""
    sensor = Sensor(160, 96, 20_000.0, intrinsics=Intrinsics.from_fov(160, 96, 60))
    camera = SimulatedCamera(sensor, seed=4, motion=MotionKind.ARC, flow_px=0.3, parallax=0.5)
    with RecordingWriter(path, sensor) as writer:
        writer.append(camera.next_frames(400))


class Service:
    """`spiked serve`, which is started again where it was."""

    def __init__(self, folder: Path, port: int, settings: dict[str, str]) -> None:
        self.data = folder / "data"
        self._folder = folder
        flags = [part for name, value in settings.items() for part in ("--set", f"{name}={value}")]
        source = f"replay:{folder / 'small.dat'}?pace=0"
        self._command = [
            sys.executable,
            "-m",
            "spiked_service",
            "serve",
            "--no-capture",
            "--no-zmq",
            "--port",
            str(port),
        ]
        self._command += ["--device", source, "--data", str(self.data), "--runtime", str(folder / "runtime")]
        self._command += [*flags, "--set", f"source_folders={folder}", "--set", "log_level=warning"]
        self.http = httpx.Client(base_url=f"http://127.0.0.1:{port}/api/v1", timeout=60)
        self.source = source
        self.start()

    def start(self) -> None:
        """Start it and wait until it answers."""
        with (self._folder / "service.log").open("ab") as log:
            self.process = subprocess.Popen(self._command, stdout=log, stderr=log)
        deadline = time.monotonic() + START_S
        while True:
            with suppress(httpx.TransportError):
                if self.http.get("/system").is_success:
                    return
            if self.process.poll() is not None or time.monotonic() > deadline:
                raise SystemExit(f"the service does not start: {(self._folder / 'service.log').read_text()[-2000:]}")
            time.sleep(0.1)

    def ask(self, method: str, path: str, **more: Any) -> Any:
        """A JSON answer."""
        answer = self.http.request(method, path, **more)
        answer.raise_for_status()
        return answer.json()

    def counts(self) -> Counter[str]:
        """Jobs by state."""
        found: Counter[str] = Counter()
        cursor = None
        while True:
            page = self.ask("GET", "/reconstructions", params={"limit": 100} | ({"cursor": cursor} if cursor else {}))
            found.update(job["state"] for job in page["items"])
            cursor = page["next_cursor"]
            if cursor is None:
                return found

    def close(self) -> None:
        """End it."""
        self.process.terminate()
        self.process.wait(30)


@dataclass(frozen=True)
class Lab:
    """What runs."""

    service: Service
    scratch: Path
    store: Store | None
    nodes: RayNodes | None
    partitions: Partitions | None


def processes(scratch: Path, *words: str) -> list[psutil.Process]:
    """Processes of attempts whose command has one of these words."""
    found = []
    for process in psutil.process_iter(["cmdline"]):
        with suppress(psutil.Error):
            line = " ".join(process.info["cmdline"] or [])
            if any(word in line for word in words) and process.environ().get("SPIKED_SCRATCH") == str(scratch):
                found.append(process)
    return found


def kill(kind: str, lab: Lab, random_: random.Random) -> bool:
    """Kill something of a kind, or cut it off. Return whether there was one."""
    if kind == "partition":
        assert lab.partitions is not None
        return lab.partitions.cut(random_)
    if kind == "service":
        service = lab.service
        service.process.kill()
        service.process.wait()
        service.start()
        return True
    if kind == "node":
        assert lab.nodes is not None
        lab.nodes.kill(random_)
        return True
    words = {
        "worker": ("spiked_service.workers reconstruction",),
        "agent": ("submitit.core._submit", "ray::_Agent"),
        "engine": ("spiked_service.cluster.engines",),
    }[kind]
    found = processes(lab.scratch, *words)
    if not found:
        return False
    with suppress(psutil.Error):
        random_.choice(found).kill()
    return True


def broken(service: Service, jobs: list[str]) -> dict[str, Any]:
    """Versions that are listed and not whole, and the sizes of all files, of jobs that have such or none."""
    found = {}
    for job in jobs:
        folder = service.data / "reconstructions" / job
        kept = versions(folder)
        half = [one.model_dump(mode="json") for one in kept if not is_whole(folder, one)]
        if half or not kept:
            found[job] = {"half": half, "files": {path.name: path.stat().st_size for path in folder.iterdir()}}
    return found


def contents(service: Service, jobs: list[str]) -> list[int]:
    """How many jobs have the same newest scene and trajectory, by content."""
    found: Counter[str] = Counter()
    for job in jobs:
        folder = service.data / "reconstructions" / job
        newest = versions(folder)[-1]
        found[
            "".join(
                hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in (newest.scene, newest.trajectory)
            )
        ] += 1
    return sorted(found.values(), reverse=True)


def outcome(lab: Lab, jobs: list[str]) -> dict[str, Any]:
    """What has become of the jobs, and what is left of their attempts."""
    service, scratch, store = lab.service, lab.scratch, lab.store
    rows = [service.ask("GET", f"/reconstructions/{job}") for job in jobs]
    complete = [row for row in rows if row["state"] == "complete"]
    newest = {row["id"]: versions(service.data / "reconstructions" / row["id"])[-1:] for row in complete}
    return {
        "states": dict(Counter(row["state"] for row in rows)),
        "half": broken(service, [row["id"] for row in complete]),
        "versions_differ": [
            row["id"] for row in complete if [one.version for one in newest[row["id"]]] != [row["version"]]
        ],
        "reasons": dict(Counter(row["reason"] for row in rows if row["state"] != "complete")),
        "alike": contents(service, [row["id"] for row in complete]),
        "left": left_in(service.data / "cluster" / "jobs") if store is None else store.left(),
        "left_in_scratch": len(list(scratch.glob("spiked-attempt-*"))),
        "processes_left": len(processes(scratch, "submitit.core._submit", "ray::_Agent", "workers reconstruction")),
    }


def use(service: Service, jobs: list[str]) -> dict[str, float]:
    """How long a worker works for a job, and the share of the time of two nodes that workers work.

    From the end of the fourth job on, as nodes, agents and their imports begin before.
    """
    ends = sorted(service.ask("GET", f"/reconstructions/{job}")["ended_at"] for job in jobs)
    logs = [service.http.get(f"/reconstructions/{job}/log").text for job in jobs]
    worked_s = [float(found) for log in logs for found in re.findall(r"worked for ([\d.]+) s", log)]
    if len(worked_s) < len(jobs) or len(jobs) < 5:
        return {}  # jobs of this machine, or attempts that did not come to an end
    node_s = 2 * (datetime.fromisoformat(ends[-1]) - datetime.fromisoformat(ends[3])).total_seconds()
    mean_s = sum(worked_s) / len(worked_s)
    return {"worker_s": round(mean_s, 3), "use": round(mean_s * (len(jobs) - 4) / node_s, 3)}


def left_in(folder: Path) -> dict[str, int | None]:
    """What is there of a folder that is the store."""
    return {"left_in_store": sum(one.is_file() for one in folder.rglob("*"))}


def arguments() -> argparse.Namespace:
    """Of the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("executor", choices=["local", "ray", "submitit"])
    parser.add_argument("--jobs", type=int, default=1000)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--every", type=float, default=4.0, help="mean seconds between two kills")
    parser.add_argument("--at-once", type=int, default=4, help="jobs that are handed to the engine at a time")
    parser.add_argument("--store", choices=list(SERVERS), help="a server of S3 to start; a folder if not given")
    parser.add_argument("--store-faults", type=float, default=0.0, help="share of requests to S3 that fail")
    parser.add_argument("--partitions", action="store_true", help="cut a machine off, too")
    parser.add_argument("--seed", type=int, default=0)
    return parser.parse_args()


def storm(asked: argparse.Namespace, lab: Lab, random_: random.Random) -> Counter[str]:
    """Kill until all jobs are over. Return how often what was killed."""
    kinds = ["worker", "worker", "agent", "agent", "engine", "service"]
    kinds += (["node"] if lab.nodes else []) + (["partition"] if lab.partitions else [])
    killed: Counter[str] = Counter()
    while True:
        counts = lab.service.counts()
        if counts["queued"] + counts["running"] == 0:
            return killed
        if killed.total() - killed["partition"] < asked.kills:
            time.sleep(random_.expovariate(1 / asked.every))
            kind = random_.choice(kinds)
            if kill(kind, lab, random_):
                killed[kind] += 1
        else:
            time.sleep(2)
        if lab.nodes:
            lab.nodes.mend()
        print(dict(counts), dict(killed), file=sys.stderr, flush=True)


def started(asked: argparse.Namespace, folder: Path, ends: ExitStack) -> Lab:
    """Start the store, the nodes and the service."""
    scratch, port = folder / "scratch", free_port()
    scratch.mkdir()
    os.environ["SPIKED_SCRATCH"] = str(scratch)
    settings = {
        "executor": asked.executor,
        "reconstruction_workers": str(asked.at_once),
        "executor_lease_s": str(LEASE_S),
        "executor_address": "local",
    }
    machine = ends.enter_context(Machine()) if asked.partitions else None
    store = None
    if asked.store:
        host = "127.0.0.1" if machine is None else machine.to_store.here
        store = s3_store(asked.store, folder, free_port(), host, ends)
        settings["executor_store"] = store.uri
    nodes = None
    if asked.executor == "ray":
        nodes = RayNodes(machine)
        ends.callback(nodes.close)
        settings["executor_address"] = nodes.address
    partitions = None
    if machine is not None:
        (folder / "python").mkdir()
        os.environ |= machine.for_agents(folder / "python")
        settings["executor_url"] = ends.enter_context(FaultyProxy(port, host=machine.to_service.here)).url
        partitions = Partitions(machine, LEASE_S)
        ends.callback(partitions.close)
    service = Service(folder, port, settings)
    ends.callback(service.close)
    return Lab(service, scratch, store, nodes, partitions)


def submitted(service: Service, jobs: int) -> list[str]:
    """Record a capture and queue so many jobs of it. Return their ids."""
    capture = service.ask("POST", "/captures", json={"device": service.source, "reconstruct": False})["id"]
    while service.ask("GET", f"/captures/{capture}")["state"] != "complete":
        time.sleep(0.1)
    body = {"capture_id": capture, "options": {"steps": 0, "threads": 1}}
    return [service.ask("POST", "/reconstructions", json=body)["id"] for _ in range(jobs)]


def main() -> None:
    """Entry point."""
    asked = arguments()
    with ExitStack() as ends:
        folder = Path(ends.enter_context(tempfile.TemporaryDirectory(prefix="spiked-cluster-")))
        recording(folder / "small.dat")
        lab = started(asked, folder, ends)
        jobs = submitted(lab.service, asked.jobs)
        if lab.store is not None:
            lab.store.proxy.share = asked.store_faults
        begun_s = time.monotonic()
        killed = storm(asked, lab, random.Random(asked.seed))
        wall_s = time.monotonic() - begun_s
        if lab.partitions is not None:
            lab.partitions.close()
        if lab.store is not None:
            lab.store.proxy.share = 0.0
        time.sleep(SWEPT_S if asked.executor != "local" else 0)
        report = {
            "executor": asked.executor,
            "store": asked.store or "folder",
            "jobs": asked.jobs,
            **outcome(lab, jobs),
            **(use(lab.service, jobs) if lab.nodes and not killed else {}),
            "faults": dict(lab.store.proxy.happened) if lab.store else {},
            "requests": lab.store.proxy.requests if lab.store else 0,
            "kills": dict(killed),
            "partitions": dict(lab.partitions.happened) if lab.partitions else {},
            "wall_s": round(wall_s, 1),
            "s_a_job": round(wall_s / asked.jobs, 3),
        }
        print(json.dumps(report))
    if (
        report["states"] != {"complete": asked.jobs}
        or report["half"]
        or report["versions_differ"]
        or len(report["alike"]) > 1
    ):
        raise SystemExit(1)


if __name__ == "__main__":
    main()
