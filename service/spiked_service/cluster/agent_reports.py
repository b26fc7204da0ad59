"""What an agent tells the service: events and signs of life, on a thread that also keeps the lease."""

import threading
import time
from contextlib import suppress

import httpx
from pydantic import TypeAdapter

from spiked.errors import SpikedError
from spiked_service.cluster.background import Background
from spiked_service.cluster.messages import (
    AttemptWork,
    Begin,
    Next,
    Order,
    Report,
    ReportAnswer,
    StoredFile,
)
from spiked_service.workers.messages import Logged, PoseEstimated, ReconstructionStatus, WorkerEvent

_BEGIN_S = 60.0
"""How long an agent tries to reach the service before it has a lease."""
_PAUSE_S = 0.5
"""Pause between two attempts to reach the service."""
_ANSWER_S = 10.0
"""Time for one answer."""
_LEAST_ANSWER_S = 1.0
"""The same as the end of the lease comes closer.

Who was cut off must notice in time, and be heard again before, by another connection: packets of the one that had no
answer are repeated ever more rarely.
"""
_MOST_EVENTS = 500
"""Events kept while the service does not answer; then only those that the outcome depends on are."""
_ASK_AGAIN_S = 0.2
"""Interval at which an agent without work asks for more."""
_EVENTS_A_REPORT = 100
"""Events of one report, which is shorter than the longest request that the service takes."""
_REFUSED = (401, 403, 404, 409, 410, 422)
"""Status codes after which it is no use to ask again."""


_next: TypeAdapter[Next | None] = TypeAdapter(Next | None)


class RefusedError(SpikedError):
    """The attempt is over: another one has begun, the job has ended, or the lease has expired."""


class UnansweredError(RefusedError):
    """The service has not answered within the lease."""


class ServiceClient:
    """The routes of an attempt."""

    def __init__(self, url: str, attempt: str, token: str) -> None:
        self._http = httpx.Client(
            base_url=url.rstrip("/"), headers={"Authorization": f"Bearer {token}"}, timeout=_ANSWER_S
        )
        self._path = f"/api/v1/attempts/{attempt}"

    def begin(self, asked: Begin) -> AttemptWork:
        """Take the attempt. Raises RefusedError."""
        return AttemptWork.model_validate_json(
            self.post(":begin", asked.model_dump_json(), time.monotonic() + _BEGIN_S)
        )

    def post(self, route: str, body: str, until_s: float, answer_s: float | None = None) -> bytes:
        """Post, again until the time `until_s` of the monotonic clock. Raises RefusedError, UnansweredError.

        One answer has `answer_s`, or half of the time that is left.
        """
        why = "it was not asked in time"
        while True:
            try:
                wait_s = answer_s or min(_ANSWER_S, max((until_s - time.monotonic()) / 2, _LEAST_ANSWER_S))
                answer = self._http.post(
                    self._path + route, content=body, headers={"Content-Type": "application/json"}, timeout=wait_s
                )
                if answer.is_success:
                    return answer.content
                if answer.status_code in _REFUSED:
                    raise RefusedError(f"the service refuses it: {answer.text}")
                why = f"it answers {answer.status_code}"
            except httpx.HTTPError as error:
                why = str(error) or type(error).__name__
            if time.monotonic() > until_s:
                raise UnansweredError(f"the service has not answered within the lease: {why}")
            time.sleep(_PAUSE_S)

    def next(self, agent: str, wait_s: float) -> Next | None:
        """Another attempt, once this one has ended; None if none waits within `wait_s`. Raises RefusedError."""
        until_s = time.monotonic() + wait_s
        while True:
            found = _next.validate_json(self.post(":next", Report(agent=agent).model_dump_json(), until_s, _ANSWER_S))
            if found is not None or time.monotonic() > until_s:
                return found
            time.sleep(_ASK_AGAIN_S)

    def close(self) -> None:
        """Close its connections."""
        self._http.close()


class AgentReports(Background):
    """Reports events in order and renews the lease. A context manager; `add` and `order` are for any thread."""

    def __init__(self, service: ServiceClient, agent: str, work: AttemptWork) -> None:
        super().__init__("reports")
        self._service = service
        self._agent = agent
        self._work = work
        self._lock = threading.Lock()
        self._sending = threading.Lock()
        self._events: list[WorkerEvent] = []
        self._files: list[StoredFile] | None = None
        self._unsent: Report | None = None
        self._sequence = 0
        self._renewed_s = time.monotonic()
        self._refused: RefusedError | None = None
        self.kept: list[WorkerEvent] = []
        """Events that the outcome depends on."""
        self.order = Order.GO_ON
        """What the service wants."""

    @property
    def lost(self) -> bool:
        """Whether the attempt is over for the service."""
        return self._refused is not None

    def check(self) -> None:
        """Raises RefusedError if the attempt is over for the service."""
        if self._refused is not None:
            raise self._refused

    def add(self, event: WorkerEvent, files: list[StoredFile] | None) -> None:
        """Report an event soon, with all files of the job if they have changed."""
        with self._lock:
            self._files = files or self._files
            if len(self._events) >= _MOST_EVENTS:
                self._events = [one for one in self._events if not isinstance(one, PoseEstimated | Logged)]
                self._events = _without_old_status(self._events)
            self._events.append(event)
            if not isinstance(event, PoseEstimated | Logged):
                self.kept = _without_old_status([*self.kept, event])

    def flush(self) -> int:
        """Report what there is, if the service answers. Return the number of the last report. Raises RefusedError."""
        with suppress(UnansweredError):
            self._send()
        return self._sequence

    def end(self) -> None:
        """The manifest is stored; a service that does not answer finds it later. Raises RefusedError."""
        with suppress(UnansweredError):
            self._post(":end", Report(agent=self._agent))

    def _run(self) -> None:
        while not self._over.wait(self._work.report_s):
            try:
                self._send()
            except RefusedError as error:
                self._refused = error
                return

    def _send(self) -> None:
        """Report all events that there are, or at least a sign of life."""
        with self._sending:
            while True:
                told = self._next_report()
                self.order = ReportAnswer.model_validate_json(self._post(":report", told)).order
                self._unsent = None
                with self._lock:
                    if not self._events:
                        return

    def _next_report(self) -> Report:
        """The report that was not answered, else one of the next events."""
        with self._lock:
            if self._unsent is None and self._events:
                self._sequence += 1
                self._unsent = Report(
                    agent=self._agent,
                    sequence=self._sequence,
                    events=self._events[:_EVENTS_A_REPORT],
                    files=self._files,
                )
                self._events, self._files = self._events[_EVENTS_A_REPORT:], None
            return self._unsent or Report(agent=self._agent)

    def _post(self, route: str, told: Report) -> bytes:
        sent_s = time.monotonic()
        answer = self._service.post(route, told.model_dump_json(), self._renewed_s + self._work.lease_s)
        self._renewed_s = sent_s
        return answer


def _without_old_status(events: list[WorkerEvent]) -> list[WorkerEvent]:
    """Events without the status messages that a later one replaces; the last one stays in its place."""
    last = next((one for one in reversed(events) if isinstance(one, ReconstructionStatus)), None)
    return [one for one in events if not isinstance(one, ReconstructionStatus) or one is last]
