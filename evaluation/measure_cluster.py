"""Jobs on other machines under random kills: `python evaluation/measure_cluster.py ray --jobs 1000 --kills 200`.

Starts a service with an executor (and for Ray a head and two nodes on this machine), queues so many small jobs, and at
random moments kills a worker, an agent, a node of Ray, the engine's process or the service, which are started again.
`--store s3-moto` and `--store s3-s3rver` start a server of S3; with `--store-faults 0.05` one of twenty requests to it
is stalled, refused or truncated. Then it looks whether every job is complete, whether the files of every version are
there that is listed, and what is left in the store. All jobs are alike, and so are their results, which are compared by
hash. Prints one JSON object; the exit status is 1 if a job is lost or half. With `local` and no kills it is the figure
to compare with.
"""

import argparse
import hashlib
import json
import os
import random
import re
import socket
import subprocess
import sys
import tempfile
import time
from collections import Counter
from contextlib import ExitStack, suppress
from datetime import datetime
from pathlib import Path
from typing import Any

import httpx
import psutil
from cluster_stores import SERVERS, Store, s3_store
from spiked_service.results.versions import versions

from spiked.recording import RecordingWriter
from spiked.sensor import Intrinsics, Sensor
from spiked.simulate import MotionKind, SimulatedCamera

LEASE_S = 10
START_S = 120.0
SWEPT_S = 60.0
"""Time after the last job for what is left to be swept: what still stalls must have failed, too."""
MARK = "SPIKED_MEASURED_NODES"
"""Variable of the environment of the processes of Ray that this run has started: others run Ray here, too."""
RAY = str(Path(sys.executable).with_name("ray"))


def recording(path: Path) -> None:
    """A small recording of a moving camera."""
    sensor = Sensor(160, 96, 20_000.0, intrinsics=Intrinsics.from_fov(160, 96, 60))
    camera = SimulatedCamera(sensor, seed=4, motion=MotionKind.ARC, flow_px=0.3, parallax=0.5)
    with RecordingWriter(path, sensor) as writer:
        writer.append(camera.next_frames(400))


def free_port() -> int:
    """A port that nobody listens on."""
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


class RayNodes:
    """A head without cores, and two nodes with one core each, all on this machine."""

    def __init__(self) -> None:
        self.port = free_port()
        self._run("--head", f"--port={self.port}", "--num-cpus=0", "--include-dashboard=false")
        self._nodes = [self._node(), self._node()]

    @property
    def address(self) -> str:
        """Of the head."""
        return f"127.0.0.1:{self.port}"

    def kill(self, random_: random.Random) -> None:
        """Kill a node with all that runs on it, and start another."""
        number = random_.randrange(2)
        for node in self._nodes[number]:
            with suppress(psutil.Error):
                for process in [*node.children(recursive=True), node]:
                    with suppress(psutil.Error):
                        process.kill()
        self._nodes[number] = self._node()

    def close(self) -> None:
        """End all nodes of this run, with what runs on them."""
        while found := self._processes():
            for process in found:
                with suppress(psutil.Error):
                    process.kill()
            psutil.wait_procs(found, timeout=10)

    def _node(self) -> list[psutil.Process]:
        """Start a node. Return its raylet, and its log monitor, which would outlive it and slow down the others."""
        before = {one.pid for one in self._processes()}
        self._run(f"--address={self.address}", "--num-cpus=1")
        return [one for one in self._processes() if one.pid not in before and _is_of_a_node(one)]

    def _processes(self) -> list[psutil.Process]:
        """All that this run has started of Ray, and what that has started: some overwrite their environment."""
        found: dict[int, psutil.Process] = {}
        for process in psutil.process_iter():
            with suppress(psutil.Error):
                if process.environ().get(MARK) == self.address and process.status() != psutil.STATUS_ZOMBIE:
                    found |= {one.pid: one for one in [process, *process.children(recursive=True)]}
        return list(found.values())

    def _run(self, *words: str) -> None:
        environment = os.environ | {MARK: self.address}
        command = [RAY, "start", "--disable-usage-stats", *words]
        subprocess.run(command, check=True, capture_output=True, env=environment)


def _is_of_a_node(process: psutil.Process) -> bool:
    with suppress(psutil.Error):
        return process.name() == "raylet" or any(part.endswith("log_monitor.py") for part in process.cmdline())
    return False


class Service:
    """`spiked serve`, which is started again where it was."""

    def __init__(self, folder: Path, settings: dict[str, str]) -> None:
        self.data = folder / "data"
        self._folder = folder
        self._port = free_port()
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
            str(self._port),
        ]
        self._command += ["--device", source, "--data", str(self.data), "--runtime", str(folder / "runtime")]
        self._command += [*flags, "--set", f"source_folders={folder}", "--set", "log_level=warning"]
        self.http = httpx.Client(base_url=f"http://127.0.0.1:{self._port}/api/v1", timeout=60)
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


def processes(scratch: Path, *words: str) -> list[psutil.Process]:
    """Processes of attempts whose command has one of these words."""
    found = []
    for process in psutil.process_iter(["cmdline"]):
        with suppress(psutil.Error):
            line = " ".join(process.info["cmdline"] or [])
            if any(word in line for word in words) and process.environ().get("SPIKED_SCRATCH") == str(scratch):
                found.append(process)
    return found


def kill(kind: str, service: Service, nodes: RayNodes | None, scratch: Path, random_: random.Random) -> bool:
    """Kill something of a kind. Return whether there was one."""
    if kind == "service":
        service.process.kill()
        service.process.wait()
        service.start()
        return True
    if kind == "node":
        assert nodes is not None
        nodes.kill(random_)
        return True
    words = {
        "worker": ("spiked_service.workers reconstruction",),
        "agent": ("submitit.core._submit", "ray::_Agent"),
        "engine": ("spiked_service.cluster.engines",),
    }[kind]
    found = processes(scratch, *words)
    if not found:
        return False
    with suppress(psutil.Error):
        random_.choice(found).kill()
    return True


def broken(service: Service, jobs: list[str]) -> list[str]:
    """Jobs whose listed versions lack a file, or have one of another size."""
    found = []
    for job in jobs:
        folder = service.data / "reconstructions" / job
        kept = versions(folder)
        whole = kept and all(
            (folder / one.scene).is_file()
            and (folder / one.scene).stat().st_size == one.scene_bytes
            and (folder / one.trajectory).is_file()
            for one in kept
        )
        if not whole:
            found.append(job)
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


def outcome(service: Service, jobs: list[str], scratch: Path, store: Store | None) -> dict[str, Any]:
    """What has become of the jobs, and what is left of their attempts."""
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
    parser.add_argument("--seed", type=int, default=0)
    return parser.parse_args()


def storm(
    asked: argparse.Namespace, service: Service, nodes: RayNodes | None, scratch: Path, random_: random.Random
) -> Counter[str]:
    """Kill until all jobs are over. Return how often what was killed."""
    kinds = ["worker", "worker", "agent", "agent", "engine", "service"] + (["node"] if nodes else [])
    killed: Counter[str] = Counter()
    while True:
        counts = service.counts()
        if counts["queued"] + counts["running"] == 0:
            return killed
        if killed.total() < asked.kills:
            time.sleep(random_.expovariate(1 / asked.every))
            kind = random_.choice(kinds)
            if kill(kind, service, nodes, scratch, random_):
                killed[kind] += 1
        else:
            time.sleep(2)
        print(dict(counts), dict(killed), file=sys.stderr, flush=True)


def main() -> None:
    """Entry point."""
    asked = arguments()
    random_ = random.Random(asked.seed)
    with ExitStack() as ends:
        folder = Path(ends.enter_context(tempfile.TemporaryDirectory(prefix="spiked-cluster-")))
        scratch = folder / "scratch"
        scratch.mkdir()
        os.environ["SPIKED_SCRATCH"] = str(scratch)
        recording(folder / "small.dat")
        store = s3_store(asked.store, folder, free_port(), ends) if asked.store else None
        nodes = RayNodes() if asked.executor == "ray" else None
        if nodes is not None:
            ends.callback(nodes.close)
        settings = {
            "executor": asked.executor,
            "reconstruction_workers": str(asked.at_once),
            "executor_lease_s": str(LEASE_S),
        }
        settings |= {"executor_address": "local" if nodes is None else nodes.address}
        settings |= {"executor_store": store.uri} if store else {}
        service = Service(folder, settings)
        ends.callback(service.close)
        capture = service.ask("POST", "/captures", json={"device": service.source, "reconstruct": False})["id"]
        while service.ask("GET", f"/captures/{capture}")["state"] != "complete":
            time.sleep(0.1)
        body = {"capture_id": capture, "options": {"steps": 0, "threads": 1}}
        jobs = [service.ask("POST", "/reconstructions", json=body)["id"] for _ in range(asked.jobs)]
        if store is not None:
            store.proxy.share = asked.store_faults
        begun_s = time.monotonic()
        killed = storm(asked, service, nodes, scratch, random_)
        wall_s = time.monotonic() - begun_s
        if store is not None:
            store.proxy.share = 0.0
        time.sleep(SWEPT_S if asked.executor != "local" else 0)
        report = {
            "executor": asked.executor,
            "store": asked.store or "folder",
            "jobs": asked.jobs,
            **outcome(service, jobs, scratch, store),
            **(use(service, jobs) if nodes and not killed else {}),
            "faults": dict(store.proxy.happened) if store else {},
            "requests": store.proxy.requests if store else 0,
            "kills": dict(killed),
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
