"""The executor of jobs on other machines: attempts by id, their tokens, their engine."""

import hashlib
import hmac
import secrets
import time
from pathlib import Path
from threading import Lock

from spiked.errors import ConfigurationError
from spiked_service.base.ids import new_id
from spiked_service.cluster.engine import Engine, EngineOptions
from spiked_service.cluster.messages import Next
from spiked_service.cluster.object_store import ObjectStore
from spiked_service.cluster.remote_worker import FencedError, RemoteWorker, Terms
from spiked_service.cluster.shared_recordings import SharedRecordings
from spiked_service.cluster.sweeper import Sweeper
from spiked_service.reconstructions.executor import OnEvent, OnExit, Worker
from spiked_service.store.rows import ReconstructionRow
from spiked_service.workers.messages import JobCommand
from spiked_service.workers.process import StandbyWorker

_KEY = "attempts.key"
"""File with the key that tokens are made with."""
_RECORDINGS = "recordings"
"""Folder in the store, beside those of the jobs."""
_LEFT_S = 10.0
"""How long an agent whose attempt has ended may take another one."""
_OWNER = b"folder in the store"
"""What the name of the service's folder is made of, with the key."""


class Cluster:
    """Runs jobs by an engine on other machines. Thread-safe.

    An attempt has a token, made of its id and a key of the data folder: whoever brings it works for that attempt and
    nothing else. Once the job has another attempt or has ended, the token is refused, which fences off the old one.
    """

    def __init__(self, folder: Path, store: str, engine: EngineOptions, terms: Terms) -> None:
        """`folder` is for its key and its log. Raises ConfigurationError for a store that cannot be used."""
        self._terms = terms
        self._key = _key(folder / _KEY)
        # What lies in there is this service's, so that it can remove what it does not know; others may share the store.
        self._store = ObjectStore(store).below(hashlib.sha256(_OWNER + self._key).hexdigest()[:16])
        self._engine = Engine(engine, folder / "engine.log", self._engine_ended)
        self._attempts: dict[str, RemoteWorker] = {}
        self._left: dict[str, tuple[str, float]] = {}
        """Attempts that have ended just now, with their agents and when that was."""
        self._lock = Lock()
        self._recordings = SharedRecordings(self._store.below(_RECORDINGS))
        self._sweeper = Sweeper(self._store, self._alive, self._recordings)
        self.url = ""
        """Address at which agents reach the service."""

    def attempt(self) -> str:
        """A new id for the next start of a job."""
        return new_id()

    def start(
        self,
        row: ReconstructionRow,
        command: JobCommand,
        on_event: OnEvent,
        on_exit: OnExit,
        standby: StandbyWorker | None,
    ) -> Worker:
        """Stage the files of a job and submit its attempt."""
        return self._worker(row, command, on_event, on_exit, adopted=False)

    def adopt(self, row: ReconstructionRow, command: JobCommand, on_event: OnEvent, on_exit: OnExit) -> Worker:
        """Wait for the agent of an attempt that was submitted before; it has a lease from now."""
        return self._worker(row, command, on_event, on_exit, adopted=True)

    def clean_up(self) -> None:
        """Remove what attempts have left that are over, now and whenever one ends."""
        self._sweeper.start()

    def check(self, attempt: str, token: str) -> None:
        """Raises FencedError unless this is the token of the attempt."""
        if not hmac.compare_digest(self.token(attempt).encode(), token.encode()):
            raise FencedError("the token is not that of the attempt")

    def worker(self, attempt: str) -> RemoteWorker:
        """A living attempt. Raises FencedError."""
        with self._lock:
            worker = self._attempts.get(attempt)
        if worker is None:
            raise FencedError("this attempt is over")
        return worker

    def end(self, attempt: str, agent: str) -> None:
        """The agent has stored all results, and may take another attempt for a while. Raises FencedError."""
        self.worker(attempt).end(agent)
        now_s = time.monotonic()
        with self._lock:
            self._left = {name: left for name, left in self._left.items() if now_s - left[1] < _LEFT_S}
            self._left[attempt] = agent, now_s

    def next_for(self, attempt: str, agent: str) -> Next | None:
        """An attempt that waits in the engine, for the agent of one that has just ended; None if none waits.

        The agent keeps its place in the engine, and what was submitted for the other attempt is cancelled. Raises
        FencedError for any other agent.
        """
        with self._lock:
            if self._left.get(attempt, ("", 0.0))[0] != agent:
                raise FencedError("this agent has not ended the attempt, or some time ago")
            taken = next((name for name, worker in self._attempts.items() if worker.claim(agent)), None)
            if taken is None:
                return None
            del self._left[attempt]
        self._engine.hand_on(attempt, taken)
        return Next(attempt=taken, token=self.token(taken))

    def token(self, attempt: str) -> str:
        """The token of an attempt."""
        return hmac.new(self._key, attempt.encode(), hashlib.sha256).hexdigest()

    def close(self) -> None:
        """End the process of the engine; what it has started goes on."""
        self._sweeper.close()
        self._engine.close()

    def _worker(
        self, row: ReconstructionRow, command: JobCommand, on_event: OnEvent, on_exit: OnExit, adopted: bool
    ) -> RemoteWorker:
        def submit() -> None:
            self._engine.submit(row.attempt, [self.url, row.attempt, self.token(row.attempt)])

        def withdraw(after_s: float) -> None:
            with self._lock:
                self._attempts.pop(row.attempt, None)
            self._sweeper.wake()
            self._engine.cancel(row.attempt, after_s)

        with self._lock:
            worker = RemoteWorker(
                row.attempt,
                command,
                self._store.below(row.id, row.attempt),
                self._recordings,
                self._terms,
                None if adopted else submit,
                bool(adopted and row.node),
                withdraw,
                on_event,
                on_exit,
            )
            self._attempts[row.attempt] = worker
        return worker

    def _alive(self, attempt: str) -> bool:
        with self._lock:
            return attempt in self._attempts

    def _engine_ended(self, attempt: str, reason: str, certain: bool) -> None:
        with self._lock:
            worker = self._attempts.get(attempt)
        if worker is not None:
            worker.engine_ended(reason, certain)


def _key(path: Path) -> bytes:
    """The key of the tokens, made at the first start. Raises ConfigurationError."""
    try:
        if not path.exists():
            path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            path.touch(0o600)
            path.write_bytes(secrets.token_bytes(32))
        key = path.read_bytes()
    except OSError as error:
        raise ConfigurationError(f"{path} cannot be used: {error.strerror}") from error
    if len(key) != 32:
        raise ConfigurationError(f"{path} is damaged: remove it; attempts that run now begin again")
    return key
