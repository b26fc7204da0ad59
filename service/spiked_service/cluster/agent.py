"""Works for one attempt on the machine that an engine has chosen: fetches files, runs the worker, stores results.

The worker is the same process as on the machine of the service, forked from one that has imported what it needs. Then
the agent takes the next attempt that waits: neither the engine nor the imports cost time again.
"""

import os
import secrets
import shutil
import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType

from spiked.errors import SpikedError
from spiked_service.cluster.agent_reports import AgentReports, RefusedError, ServiceClient
from spiked_service.cluster.checkpoint_copies import CheckpointCopies
from spiked_service.cluster.job_files import INPUTS, LOG, MANIFEST, OUTPUTS, files_in, moved, of_a_version
from spiked_service.cluster.messages import AttemptWork, Begin, Manifest, Next, Order, StoredFile
from spiked_service.cluster.object_store import ObjectStore, stored_file
from spiked_service.cluster.recording_cache import RecordingCache, cache_folder
from spiked_service.cluster.scratch import scratch_folder
from spiked_service.results.versions import INDEX
from spiked_service.workers.forks import ForkedWorkers
from spiked_service.workers.messages import JobCommand, Role, VersionPublished, WorkerEvent
from spiked_service.workers.process import StandbyWorker, WorkerProcess

_LOOK_S = 0.1
"""Interval at which the orders of the service are looked at."""
SERVES_S = 3600.0
"""Time after which an agent takes no more attempts, so that its place in the engine goes round."""
_IDLE_S = 2.0
"""How long an agent waits for another attempt, since the queue hands on the next when one has ended."""


def run_agent(url: str, attempt: str, token: str, serves_s: float = SERVES_S) -> None:
    """Work for an attempt to its end, then for others that wait, until `serves_s`. Returns early if one is over.

    Raises SpikedError and OSError if the results of one cannot be stored: the service then begins another attempt.
    """
    following: Next | None = Next(attempt=attempt, token=token)
    with _Agent(url, serves_s) as agent:
        while following is not None:
            following = agent.work_for(following)


class _Agent:
    """Works for one attempt after the other. A context manager, which ends its workers."""

    def __init__(self, url: str, serves_s: float) -> None:
        self._url = url
        self._id = secrets.token_hex(8)
        self._until_s = time.monotonic() + serves_s
        self._forks: dict[Role, ForkedWorkers] = {}
        self._number = 0

    def __enter__(self) -> "_Agent":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for forks in self._forks.values():
            forks.close()

    def work_for(self, given: Next) -> Next | None:
        """Work for an attempt. Return the next one, if there is one and its time is not over."""
        self._number += 1
        service = ServiceClient(self._url, given.attempt, given.token)
        try:
            work = service.begin(Begin(agent=self._id, node=socket.gethostname()))
            with scratch_folder() as folder, AgentReports(service, self._id, work) as reports:
                _Attempt(given.attempt, self._number, work, reports, folder, self._standby).run()
            return service.next(self._id, _IDLE_S) if time.monotonic() < self._until_s else None
        except RefusedError as error:
            print(f"attempt {given.attempt}: {error}", flush=True)
            return None
        finally:
            service.close()

    def _standby(self, role: Role, log: Path) -> StandbyWorker:
        if role not in self._forks:
            self._forks[role] = ForkedWorkers(role)
        return self._forks[role].standby(log)


class _Attempt:
    """An attempt with its worker, in a folder of its own."""

    def __init__(
        self,
        attempt: str,
        number: int,
        work: AttemptWork,
        reports: AgentReports,
        folder: Path,
        standby: Callable[[Role, Path], StandbyWorker],
    ) -> None:
        self._attempt = attempt
        self._number = number
        """How many attempts its agent has worked for."""
        self._work = work
        self._reports = reports
        self._folder = folder
        self._standby = standby
        self._job = folder / "job"
        self._store = ObjectStore(work.store, reports.check)
        self._stored: set[str] = set()
        """Hashes of what is stored."""
        self._trouble: str | None = None
        self._exited = threading.Event()

    def run(self) -> None:
        """Raises RefusedError once the attempt is over for the service, ObjectStoreError and OSError."""
        begun_s = time.monotonic()
        command = self._fetch()
        copies = CheckpointCopies(self._job, self._folder / "checkpoint", self._store)
        if command is not None:
            fetched_s = time.monotonic()
            with copies:
                self._run_worker(command)
            worked_s = time.monotonic() - fetched_s
            with (self._job / LOG).open("a") as log:
                took = f"fetched its files in {fetched_s - begun_s:.2f} s, worked for {worked_s:.2f} s"
                print(f"attempt {self._number} of its agent: {took}", file=log)
        self._reports.check()
        manifest = Manifest(
            attempt=self._attempt,
            node=socket.gethostname(),
            trouble=self._trouble,
            files=self._store_files(),
            reports=self._reports.flush(),
            events=self._reports.kept,
            checkpoint=None if command is None else copies.last(),
        )
        self._store.put(MANIFEST, manifest.model_dump_json().encode())
        self._reports.end()

    def _fetch(self) -> JobCommand | None:
        """Fetch the inputs. Return the command for the worker, None if they cannot be had."""
        inputs, command = self._work.inputs, self._work.command
        recordings = ObjectStore(self._work.recordings, self._reports.check)

        def fetch(stored: StoredFile, path: Path) -> None:
            recordings.fetch(stored.sha256, path, stored)

        assert isinstance(command, JobCommand)
        recording = self._folder / "recording"
        self._job.mkdir()
        try:
            for stored in inputs.folder:
                self._store.fetch(f"{INPUTS}/{stored.sha256}", self._job / stored.name, stored)
            if inputs.recording:
                RecordingCache(cache_folder(), self._work.cache_bytes, fetch).put_into(recording, inputs.recording)
        except (SpikedError, OSError) as error:
            self._trouble = f"its files cannot be fetched on {socket.gethostname()}: {error}"
            return None
        return moved(command, self._job, None if inputs.in_place else recording)

    def _run_worker(self, command: JobCommand) -> None:
        log = self._job / LOG
        try:
            worker = WorkerProcess(command, log, self._take, self._worker_ended, self._standby(command.role, log))
        except OSError as error:
            self._trouble = f"its worker could not be started on {socket.gethostname()}: {error.strerror}"
            return
        told = Order.GO_ON
        try:
            while not self._exited.wait(_LOOK_S):
                if self._reports.lost or self._reports.order is Order.LEAVE:
                    return
                if self._reports.order is not told:
                    told = self._reports.order
                    worker.stop()
        finally:
            worker.dismiss()
            worker.kill_after(self._work.grace_s)

    def _worker_ended(self, trouble: str | None) -> None:
        # Its own log is gone with this folder, and is in that of the job.
        self._trouble = trouble and trouble.replace(str(self._job / LOG), "the log of the job")
        self._exited.set()

    def _take(self, event: WorkerEvent) -> None:
        """An event of the worker, on its thread: the files of a version are stored before it is reported."""
        self._reports.add(event, self._store_files() if isinstance(event, VersionPublished) else None)

    def _store_files(self) -> list[StoredFile]:
        """Store what has changed in the folder of the job. Return all of it."""
        snapshot = self._folder / "snapshot"
        found = []
        try:
            _link(self._job, snapshot)
            for path in files_in(snapshot, with_log=True):
                stored = stored_file(path, path.relative_to(snapshot).as_posix())
                if stored.sha256 not in self._stored:
                    self._store.put_file(path, f"{OUTPUTS}/{stored.sha256}", stored)
                    self._stored.add(stored.sha256)
                found.append(stored)
        finally:
            shutil.rmtree(snapshot, ignore_errors=True)
        return found


def _link(folder: Path, snapshot: Path) -> None:
    """Give the files of a folder that its worker still writes a second name, as they are at one moment.

    Files of a version never change and may be removed; the others are small and copied. The index is replaced after the
    files that it names are there, so that what it names is found if it is still the same afterwards.
    """
    while True:
        shutil.rmtree(snapshot, ignore_errors=True)
        before = _content(folder / INDEX)
        try:
            for path in files_in(folder, with_log=True):
                target = snapshot / path.relative_to(folder)
                target.parent.mkdir(parents=True, exist_ok=True)
                if of_a_version(path):
                    os.link(path, target)
                else:
                    shutil.copyfile(path, target)
        except FileNotFoundError:
            continue  # a version was removed meanwhile, because there is a newer one
        if _content(folder / INDEX) == before:
            snapshot.mkdir(exist_ok=True)
            return


def _content(path: Path) -> bytes:
    return path.read_bytes() if path.exists() else b""
