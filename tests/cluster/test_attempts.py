"""Both ends of an attempt, one at a time: what goes wrong between them."""

import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from queue import SimpleQueue

import pytest
from spiked_service.cluster import object_store
from spiked_service.cluster.agent_reports import AgentReports, ServiceClient, UnansweredError
from spiked_service.cluster.messages import AttemptWork, Begin, Inputs, Order, Report, ReportAnswer
from spiked_service.cluster.object_store import ObjectStore
from spiked_service.cluster.remote_worker import FencedError, RemoteWorker, Terms
from spiked_service.cluster.shared_recordings import SharedRecordings
from spiked_service.settings.reconstruction_options import ReconstructionOptions
from spiked_service.workers.messages import (
    FramesSkipped,
    NodeFound,
    NotBegun,
    PlaceCompared,
    ReconstructionCommand,
    WorkerError,
    WorkerEvent,
)
from waiting import until

TERMS = Terms(lease_s=4.0, grace_s=1.0)


@pytest.fixture
def command(tmp_path: Path) -> ReconstructionCommand:
    (tmp_path / "job").mkdir()
    return ReconstructionCommand(
        ring=None,
        recording=tmp_path / "recording.dat",
        folder=tmp_path / "job",
        can_block=True,
        options=ReconstructionOptions(),
        intrinsics=None,
    )


class Attempt:
    """A worker of the service without an engine, and what it has told."""

    def __init__(
        self,
        command: ReconstructionCommand,
        store: Path,
        on_event: Callable[[WorkerEvent], None],
        adopted: bool = False,
        begun: bool = False,
        lease_s: float = TERMS.lease_s,
    ) -> None:
        self.submitted = threading.Event()
        self.withdrawn: list[float] = []
        self.exits: SimpleQueue[str | None] = SimpleQueue()
        self.worker = RemoteWorker(
            "one",
            command,
            ObjectStore(store.as_uri()),
            SharedRecordings(ObjectStore(f"{store.as_uri()}/recordings")),
            replace(TERMS, lease_s=lease_s),
            None if adopted else self.submitted.set,
            begun,
            self.withdrawn.append,
            on_event,
            self.exits.put,
        )

    def begin(self) -> AttemptWork:
        assert self.submitted.wait(10)
        return self.worker.begin(Begin(agent="a", node="there"))


def test_a_report_that_is_sent_again_counts_once(command: ReconstructionCommand, tmp_path: Path) -> None:
    events: list[WorkerEvent] = []
    one = Attempt(command, tmp_path / "store", events.append)
    one.begin()
    told = Report(agent="a", sequence=1, events=[FramesSkipped(frames=9, skipped=1)])
    one.worker.report(told)
    one.worker.report(told)
    one.worker.report(Report(agent="a", sequence=2, events=[WorkerError(reason="no light")]))
    until(lambda: len(events) >= 3, "all are taken")
    assert [type(event) for event in events] == [NodeFound, FramesSkipped, WorkerError]
    one.worker.dismiss()
    assert one.worker.report(Report(agent="a")).order is Order.LEAVE
    assert "does not answer" in f"{one.exits.get(timeout=30)}", "it did not leave within the grace"
    with pytest.raises(FencedError):
        one.worker.report(Report(agent="a"))
    assert one.withdrawn == [0.0]


def test_a_job_that_is_cancelled_ends_even_if_its_agent_does_not(
    command: ReconstructionCommand, tmp_path: Path
) -> None:
    waiting = Attempt(command, tmp_path / "store", lambda event: None)
    assert waiting.submitted.wait(10)
    waiting.worker.cancel()
    assert "before it began" in f"{waiting.exits.get(timeout=30)}"
    begun = Attempt(command, tmp_path / "store", lambda event: None)
    begun.begin()
    begun.worker.cancel()
    assert begun.worker.report(Report(agent="a")).order is Order.STOP, "what it has is published"
    assert "does not answer" in f"{begun.exits.get(timeout=30)}", "it did not end within the grace"
    assert begun.withdrawn == [0.0]


def test_an_event_that_cannot_be_taken_ends_the_attempt(command: ReconstructionCommand, tmp_path: Path) -> None:
    def refuse(event: WorkerEvent) -> None:
        raise RuntimeError("a fault of this service")

    one = Attempt(command, tmp_path / "store", refuse)
    one.begin()
    assert "see the log of the service" in f"{one.exits.get(timeout=30)}"


def test_an_attempt_that_the_engine_has_lost_ends_unless_it_has_begun(
    command: ReconstructionCommand, tmp_path: Path
) -> None:
    events: list[WorkerEvent] = []
    waiting = Attempt(command, tmp_path / "store", events.append)
    assert waiting.submitted.wait(10)
    waiting.worker.engine_ended("the engine has ended", False)
    assert waiting.exits.get(timeout=30) == "the engine has ended"
    assert events == [NotBegun()], "nothing is known against the job"
    events.clear()
    begun = Attempt(command, tmp_path / "store", events.append)
    begun.begin()
    begun.worker.engine_ended("the engine has ended", False)
    assert begun.worker.report(Report(agent="a")).order is Order.GO_ON
    begun.worker.engine_ended("its process has ended", True)
    assert begun.exits.get(timeout=30) == "its process has ended"
    assert events == [NodeFound(node="there")]


def test_an_agent_that_the_engine_has_ended_before_it_began_counts(
    command: ReconstructionCommand, tmp_path: Path
) -> None:
    events: list[WorkerEvent] = []
    one = Attempt(command, tmp_path / "store", events.append)
    assert one.submitted.wait(10)
    one.worker.engine_ended("its process has ended", True)
    assert one.exits.get(timeout=30) == "its process has ended"
    assert events == [], "an agent that dies at its start would do so for ever"


def test_a_restarted_service_gives_the_work_of_an_attempt_that_waited_in_the_engine(
    command: ReconstructionCommand, tmp_path: Path
) -> None:
    events: list[WorkerEvent] = []
    waiting = Attempt(command, tmp_path / "store", events.append, adopted=True)

    def begins() -> AttemptWork | None:
        with suppress(FencedError):  # its files are being staged
            return waiting.worker.begin(Begin(agent="a", node="there"))
        return None

    assert until(begins, "it is given its work").inputs.in_place
    until(lambda: events == [NodeFound(node="there")], "its machine is known")
    assert not waiting.submitted.is_set(), "the engine has it already"
    waiting.worker.dismiss()
    waiting.worker.kill_after(0)

    begun = Attempt(command, tmp_path / "store", events.append, adopted=True, begun=True)
    with pytest.raises(FencedError):
        begun.worker.begin(Begin(agent="b", node="there"))
    begun.worker.report(Report(agent="a"))
    begun.worker.kill_after(0)


def test_an_attempt_that_waits_is_kept_for_the_agent_that_claims_it(
    command: ReconstructionCommand, tmp_path: Path
) -> None:
    events: list[WorkerEvent] = []
    one = Attempt(command, tmp_path / "store", events.append)
    assert one.submitted.wait(10)
    assert one.worker.claim("a")
    assert not one.worker.claim("b"), "it is taken"
    with pytest.raises(FencedError):
        one.worker.begin(Begin(agent="b", node="late"))
    with pytest.raises(FencedError):
        one.worker.report(Report(agent="b"))
    one.worker.begin(Begin(agent="a", node="there"))
    assert not one.worker.claim("a"), "it has begun"
    until(lambda: events == [NodeFound(node="there")], "its machine is known")
    one.worker.dismiss()
    one.worker.kill_after(0)
    assert not one.worker.claim("c"), "it is over"


def test_an_attempt_whose_next_agent_dies_counts_for_nothing(command: ReconstructionCommand, tmp_path: Path) -> None:
    events: list[WorkerEvent] = []
    one = Attempt(command, tmp_path / "store", events.append, lease_s=0.5)
    assert one.submitted.wait(10)
    assert one.worker.claim("a")
    assert "no machine has begun it" in f"{one.exits.get(timeout=30)}"
    assert events == [NotBegun()]


@pytest.mark.parametrize("begun", [False, True])
def test_an_attempt_that_nobody_reports_of_after_a_restart_is_over(
    command: ReconstructionCommand, tmp_path: Path, begun: bool
) -> None:
    events: list[WorkerEvent] = []
    one = Attempt(command, tmp_path / "store", events.append, adopted=True, begun=begun, lease_s=0.5)
    assert ("does not answer" if begun else "no machine has begun") in f"{one.exits.get(timeout=30)}"
    assert events == ([] if begun else [NotBegun()])


def test_a_store_that_is_away_is_not_held_against_the_job(
    command: ReconstructionCommand, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(object_store, "_DELAYS_S", ())
    (command.folder / "map.json").write_text("an input")
    (tmp_path / "store").write_text("no folder")
    events: list[WorkerEvent] = []
    one = Attempt(command, tmp_path / "store", events.append)
    assert "cannot be stored" in f"{one.exits.get(timeout=30)}"
    assert events == [NotBegun()]


class Answers(ServiceClient):
    """A service that answers, or does not, and what it was sent."""

    def __init__(self) -> None:
        self.sent: list[Report] = []
        self.silent = False

    def post(self, route: str, body: str, until_s: float) -> bytes:
        if self.silent:
            raise UnansweredError("nobody is there")
        self.sent.append(Report.model_validate_json(body))
        return ReportAnswer(order=Order.GO_ON).model_dump_json().encode()


def work(command: ReconstructionCommand) -> AttemptWork:
    inputs = Inputs(recording=[], folder=[], in_place=True)
    return AttemptWork(
        command=command,
        inputs=inputs,
        store="file:///s",
        recordings="file:///r",
        cache_bytes=0,
        lease_s=4,
        report_s=0.05,
        grace_s=1,
    )


def test_many_events_are_told_in_several_reports_and_in_order(command: ReconstructionCommand) -> None:
    service = Answers()
    with AgentReports(service, "a", work(command)) as reports:
        for number in range(450):
            reports.add(PlaceCompared(recognised=True, reason=f"{number}"), None)
        last = reports.flush()
    told = [one for one in service.sent if one.events]
    assert [one.sequence for one in told] == list(range(1, last + 1))
    assert max(len(one.events) for one in told) <= 100
    reasons = [event.reason for one in told for event in one.events if isinstance(event, PlaceCompared)]
    assert reasons == [f"{number}" for number in range(450)]


def test_an_agent_keeps_what_a_silent_service_was_not_told(command: ReconstructionCommand) -> None:
    service = Answers()
    service.silent = True
    with AgentReports(service, "a", work(command)) as reports:
        reports.add(WorkerError(reason="no light"), None)
        until(lambda: reports.lost, "it gives up")
        assert reports.flush() == 1
        reports.end()
        assert [type(event) for event in reports.kept] == [WorkerError]
    assert service.sent == []
