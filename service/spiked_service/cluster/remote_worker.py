"""The service's end of an attempt on another machine: its lease, its events, its results."""

import queue
import shutil
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from pydantic import ValidationError

from spiked.errors import SpikedError
from spiked.recon.checkpoint_file import CHECKPOINT
from spiked_service.cluster.attempt_log import AttemptLog
from spiked_service.cluster.checkpoint_copies import fetch_copy, newest_copy
from spiked_service.cluster.job_files import LOG, MANIFEST, stage
from spiked_service.cluster.job_folder import JobFolder
from spiked_service.cluster.messages import (
    AttemptWork,
    Begin,
    CheckpointCopy,
    Inputs,
    Manifest,
    Order,
    Report,
    ReportAnswer,
    StoredFile,
)
from spiked_service.cluster.object_store import ObjectStore, ObjectStoreError
from spiked_service.cluster.shared_recordings import SharedRecordings
from spiked_service.events.logging import logger
from spiked_service.workers.messages import JobCommand, Logged, NodeFound, NotBegun, WorkerEvent
from spiked_service.workers.process import relay

_log = logger("spiked.cluster")
_LOOK_S = 0.5
"""Interval at which lease and orders are checked."""
_OVERDUE = 1.5
"""The service waits this many leases for an agent, so that its worker has ended before another attempt begins."""
_LAST_S = 2.0
"""Time for the store, once an attempt is to be over: nobody waits for one that stalls."""
REPORT_S = 1.0
"""Interval of an agent's reports, and at most a fifth of the lease."""


class FencedError(SpikedError):
    """The attempt is over, or another agent has it."""


@dataclass(frozen=True)
class Terms:
    """What holds for every attempt."""

    lease_s: float
    grace_s: float = 10.0
    cache_bytes: int = 0
    """Bytes of recordings that a machine keeps."""

    @property
    def report_s(self) -> float:
        """Interval of reports."""
        return min(REPORT_S, self.lease_s / 5)


class RemoteWorker:
    """An attempt at a job. Its thread stages the files, submits it, takes what agents report, and ends it.

    `begin`, `report` and `end` are called for requests of the agent, on any thread.
    """

    pid = None

    def __init__(
        self,
        attempt: str,
        command: JobCommand,
        store: ObjectStore,
        recordings: SharedRecordings,
        terms: Terms,
        submit: Callable[[], None] | None,
        begun: bool,
        withdraw: Callable[[float], None],
        on_event: Callable[[WorkerEvent], None],
        on_exit: Callable[[str | None], None],
    ) -> None:
        """`store` is that of the attempt, `recordings` are for all.

        `submit` gives the attempt to the engine; None for one that it has already.
        `begun` is whether a machine has taken it, as far as an earlier service knew.
        `withdraw` has the engine end what is left of it after so many seconds.
        """
        self._attempt = attempt
        self._command = command
        self._store = store.until(self._check_wanted)
        self._recordings = recordings
        self._terms = terms
        self._submit = submit
        self._begun = begun
        if begun:
            recordings.hold_all(attempt)
        self._withdraw = withdraw
        self._on_event = on_event
        self._on_exit = on_exit
        self._inputs: Inputs | None = None
        self._log = AttemptLog(command.folder / LOG, attempt)
        self._folder = JobFolder(command.folder, self._log)
        self._agent: str | None = None
        self._claim: str | None = None
        """The agent that is to begin it, after another attempt."""
        self._taken = 0
        """Number of the last report that was taken, and ..."""
        self._complete = submit is not None
        """... whether none was missed."""
        self._order = Order.GO_ON
        self._left_s: float | None = None
        self._seen_s = time.monotonic()
        self._not_begun = False
        """Whether the attempt is over before any agent has begun it, for a reason that is not the job's."""
        self._messages: queue.SimpleQueue[Report | str | None] = queue.SimpleQueue()
        self._lock = threading.Lock()
        self._detached = False
        self._withdrawn_s: float | None = None
        self._stored = False
        """Whether its agent has stored all and is about to exit."""
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"attempt {attempt}", daemon=True)
        self._thread.start()

    def claim(self, agent: str) -> bool:
        """Keep it for an agent that will begin it now. Return whether that can be: it waits in the engine."""
        with self._lock:
            waits = self._inputs is not None and self._agent is None and not self._begun
            if not waits or self._claim or self._ended.is_set() or self._order is not Order.GO_ON:
                return False
            self._claim, self._seen_s = agent, time.monotonic()
            return True

    def begin(self, asked: Begin) -> AttemptWork:
        """Give the work to an agent. Raises FencedError if another one has it or it is over."""
        with self._lock:
            if self._inputs is None:
                raise FencedError("the attempt is over, or does not wait for an agent")
            self._check(asked.agent, begins=True)
            self._seen_s = time.monotonic()
            if self._agent is None:
                self._agent = asked.agent
                self._messages.put(Report(agent=asked.agent, events=[NodeFound(node=asked.node)]))
            return AttemptWork(
                command=self._command,
                inputs=self._inputs,
                store=self._store.uri,
                recordings=self._recordings.store.uri,
                cache_bytes=self._terms.cache_bytes,
                lease_s=self._terms.lease_s,
                report_s=self._terms.report_s,
                grace_s=self._terms.grace_s,
            )

    def report(self, told: Report) -> ReportAnswer:
        """Renew the lease and take events. Raises FencedError if another agent has it or it is over."""
        with self._lock:
            self._check(told.agent)
            self._seen_s = time.monotonic()
            if told.events:
                self._messages.put(told)
            return ReportAnswer(order=self._order)

    def end(self, agent: str) -> None:
        """The manifest is stored. Raises FencedError if another agent has it or it is over."""
        with self._lock:
            self._check(agent)
            self._messages.put("")

    def engine_ended(self, reason: str, certain: bool) -> None:
        """The engine has ended the attempt; if that is not `certain`, an agent that has begun may go on."""
        with self._lock:
            begun = self._begun or self._agent is not None
            self._not_begun = not (begun or certain)
        if certain or not begun:
            self._messages.put(reason or "the engine has ended its task")

    def stop(self) -> None:
        """Ask it to finish its work and exit."""
        with self._lock:
            if self._order is Order.GO_ON:
                self._order = Order.STOP
        self._messages.put(None)

    def cancel(self) -> None:
        """Ask it to finish its work and exit within the time of grace, or at once if no machine has begun it."""
        with self._lock:
            if self._agent is None and not self._begun:
                self._order = Order.LEAVE
            elif self._order is Order.GO_ON:
                self._order = Order.STOP
            self._left_s = self._left_s or time.monotonic()
        self._messages.put(None)

    def dismiss(self) -> None:
        """Ask it to exit; it is withdrawn after the time of grace."""
        with self._lock:
            self._order = Order.LEAVE
            self._left_s = self._left_s or time.monotonic()
        self._messages.put(None)

    def detach(self) -> None:
        """The service ends; the attempt goes on."""
        self._detached = True
        self._messages.put(None)

    def kill_after(self, timeout_s: float) -> None:
        """Wait for the exit; withdraw the attempt after `timeout_s`."""
        self._thread.join(timeout_s)
        if self._thread.is_alive() and not self._detached:
            self._withdrawn_s = time.monotonic()
            self._messages.put("it was withdrawn")
            self._thread.join()

    def _check(self, agent: str, begins: bool = False) -> None:
        if self._ended.is_set() or (self._agent or self._claim) not in (None, agent):
            raise FencedError("the attempt is over, or another agent has it")
        if not begins:
            self._agent = agent  # of an attempt that began before the service did

    def _check_wanted(self) -> None:
        """Raises ObjectStoreError once nobody waits for the store any more."""
        now_s = time.monotonic()
        withdrawn = self._withdrawn_s is not None and now_s - self._withdrawn_s > _LAST_S
        if self._detached or withdrawn or self._overstays(_LAST_S):
            raise ObjectStoreError(f"the store {self._store.uri} has not answered before the attempt was over")

    def _run(self) -> None:
        try:
            trouble = self._follow()
        except ObjectStoreError as error:
            trouble = str(error)
            self._not_begun = self._agent is None and not self._begun
        except (SpikedError, OSError) as error:
            _log.warning("attempt failed", attempt=self._attempt, reason=str(error))
            trouble = str(error)
        except Exception:  # on_exit must be called whatever fails here
            _log.exception("attempt not followed", attempt=self._attempt)
            trouble = "a report of its agent could not be processed: see the log of the service"
        if self._detached:
            return
        with self._lock:
            self._ended.set()
        if self._not_begun:
            self._on_event(NotBegun())
        elif trouble is not None:
            with suppress(OSError):
                self._log.end(trouble)
        self._recordings.release(self._attempt)
        self._withdraw(self._terms.grace_s if self._stored else 0.0)
        self._on_exit(trouble)

    def _follow(self) -> str | None:
        """Follow the attempt to its end. Return the trouble of its worker."""
        if self._submit is None and self._store.get(MANIFEST) is not None:
            return self._finish("")  # it has ended meanwhile
        if not self._begun:
            inputs = stage(self._command, self._store, self._hold)
            with self._lock:
                self._inputs, self._seen_s = inputs, time.monotonic()
            if self._submit is not None and not (self._detached or self._left_s):
                self._submit()
        while not self._detached:
            try:
                message = self._messages.get(timeout=_LOOK_S)
            except queue.Empty:
                message = None
            if isinstance(message, Report):
                self._take(message)
            elif message is not None or self._overdue():
                return self._finish(message or self._silence())
            elif message is None and self._left_s and self._agent is None:
                return "it was ended before it began"
        return None

    def _hold(self, folder: Path) -> list[StoredFile]:
        return self._recordings.hold(folder, self._attempt, self._check_wanted)

    def _overstays(self, more_s: float) -> bool:
        """Whether the time of grace is over since that long."""
        grace_s = self._terms.grace_s + 2 * self._terms.report_s
        return self._left_s is not None and time.monotonic() - self._left_s > grace_s + more_s

    def _overdue(self) -> bool:
        """Whether the lease has expired, or the time of grace; one that waits in the engine has no lease yet."""
        now_s = time.monotonic()
        if self._overstays(0):
            return True
        begun = (self._agent or self._claim) is not None or self._submit is None
        return begun and now_s - self._seen_s > _OVERDUE * self._terms.lease_s

    def _silence(self) -> str:
        """Why an attempt is overdue."""
        with self._lock:
            if self._agent is None and not (self._begun or self._left_s):
                # The engine of an earlier service has forgotten it or has no room, or who was to begin it has died.
                self._not_begun = True
                return "no machine has begun it within the lease"
            return "its machine does not answer any more"

    def _take(self, told: Report) -> None:
        if told.sequence and told.sequence <= self._taken:
            return  # its answer was lost
        if told.files is not None:
            self._folder.fetch(told.files, self._store)
        self._deliver(told.events)
        self._complete = self._complete and told.sequence in (0, self._taken + 1)
        self._taken = max(self._taken, told.sequence)

    def _deliver(self, events: list[WorkerEvent]) -> None:
        for event in events:
            if isinstance(event, NodeFound):
                self._log.begin(event.node)
            if isinstance(event, Logged):
                relay(event)
            else:
                self._on_event(event)

    def _finish(self, reason: str) -> str | None:
        """The trouble of an attempt that is over: as its manifest says, else the reason."""
        content = self._store.get(MANIFEST)
        if content is None:
            self._take_checkpoint(newest_copy(self._store), over=False)
            return reason or "its agent has ended without a result"
        try:
            manifest = Manifest.model_validate_json(content)
        except ValidationError:
            return "the manifest of its results cannot be read"
        self._folder.fetch(manifest.files, self._store)
        self._take_checkpoint(manifest.checkpoint, over=manifest.trouble is None)
        self._stored = True
        if not (self._complete and manifest.reports == self._taken):
            self._deliver(manifest.events)  # again, which changes nothing for those that have arrived
        return manifest.trouble

    def _take_checkpoint(self, copy: CheckpointCopy | None, over: bool) -> None:
        """The next attempt goes on from it, or from the one before unless the work is over."""
        if copy is not None:
            fetch_copy(self._store, copy, self._command.folder)
        elif over:
            shutil.rmtree(self._command.folder / CHECKPOINT, ignore_errors=True)
