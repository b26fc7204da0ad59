"""A service whose jobs run elsewhere, by submitit's local executor if nothing else is said."""

import json
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import psutil
from ports import free_port
from waiting import until

SHORT = {"steps": 20}
LONG = {"steps": 200_000}
LOCALLY = {"executor": "submitit", "executor_address": "local"}
LEASE_S = 30.0
SHORT_LEASE_S = 4.0


class Lab:
    """A service whose jobs run elsewhere, at one address over its restarts."""

    def __init__(
        self,
        daemon: Callable[..., Any],
        moving: Path,
        scratch: Path,
        lease_s: float,
        store: str | None = None,
        engine: dict[str, str] = LOCALLY,
        port: int | None = None,
    ) -> None:
        self._lease_s = lease_s
        self._uri = store
        self._engine = engine
        self._port = free_port() if port is None else port
        self._daemon = daemon
        self._moving = moving
        self.scratch = scratch
        self.start()
        source = f"replay:{moving}?pace=0"
        self.capture = self.post("captures", device=source, reconstruct=False)["id"]
        until(lambda: self.get(f"captures/{self.capture}")["state"] == "complete", "the capture is complete")

    def start(self) -> None:
        settings = self._engine | {
            "executor_lease_s": str(self._lease_s),
            "reconstruction_workers": "2",
            "source_folders": str(self._moving.parent),
        }
        settings |= {} if self._uri is None else {"executor_store": self._uri}
        flags = [part for name, value in settings.items() for part in ("--set", f"{name}={value}")]
        source = f"replay:{self._moving}?pace=0"
        self.one = self._daemon("--port", str(self._port), "--device", source, "--no-capture", "--no-zmq", *flags)

    def get(self, path: str) -> Any:
        return self.one.http.get(path).raise_for_status().json()

    def post(self, path: str, **body: Any) -> Any:
        answer = self.one.http.post(path, json=body)
        assert answer.is_success, answer.text
        return answer.json()

    def submit(self, options: dict[str, Any]) -> str:
        return str(self.post("reconstructions", capture_id=self.capture, options=options)["id"])

    def job(self, job: str) -> Any:
        return self.get(f"reconstructions/{job}")

    def reached(self, job: str, wanted: Callable[[Any], bool], what: str) -> Any:
        until(lambda: wanted(self.job(job)), f"{what}: {self.job(job)}")
        return self.job(job)

    def folder(self, job: str) -> Path:
        return Path(self.one.data) / "reconstructions" / job

    def store(self) -> Path:
        return Path(self.one.data) / "cluster" / "jobs"

    def attempt(self, job: str) -> str:
        return str(json.loads((self.folder(job) / "reconstruction.json").read_text())["attempt"])

    def log(self, job: str) -> str:
        return self.one.http.get(f"reconstructions/{job}/log").text

    def processes(self, word: str) -> list[psutil.Process]:
        """Processes of attempts of this test: workers, or agents."""
        found = []
        for process in psutil.process_iter(["cmdline"]):
            with suppress(psutil.Error):
                line = process.info["cmdline"] or []
                if word in line and process.environ().get("SPIKED_SCRATCH") == str(self.scratch):
                    found.append(process)
        return found

    def agents(self) -> list[psutil.Process]:
        return self.processes("submitit.core._submit")

    def workers(self) -> list[psutil.Process]:
        """Forked ones, whose server has their command line."""
        found = self.processes("spiked_service.workers")
        return [one for one in found if one.parent() in found]

    def agent_of(self, worker: psutil.Process) -> int:
        """Process id of the agent whose server has forked a worker."""
        server = worker.parent()
        assert server is not None
        return server.ppid()

    def nothing_left(self) -> bool:
        """Whether no process, folder or object of an attempt is left."""
        objects = [one for one in self.store().rglob("*") if one.is_file()]
        return not (
            self.agents() or self.processes("spiked_service.workers") or objects or list(self.scratch.iterdir())
        )


def complete(row: Any) -> bool:
    assert row["state"] != "failed", row["reason"]
    return bool(row["state"] == "complete")
