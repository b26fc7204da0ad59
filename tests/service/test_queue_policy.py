"""Order, limit, precedence and retries of the queue."""

import time
from datetime import UTC, datetime
from typing import Any

import pytest
from spiked_service.reconstructions.queue_policy import QueuePolicy
from spiked_service.store.rows import JobState, ReconstructionRow, Stage

BEGAN = datetime(2026, 1, 1, tzinfo=UTC)


def row(name: str, live: bool = True, **fields: Any) -> ReconstructionRow:
    return ReconstructionRow(name, "capture", live, JobState.RUNNING, BEGAN, **fields)


def test_a_live_one_returns_to_the_queue_when_others_refine_up_to_the_limit() -> None:
    policy = QueuePolicy()
    refining = row("refining", stage=Stage.REFINING)
    tracking = row("tracking", stage=Stage.TRACKING)
    from_recording = row("from recording", live=False, stage=Stage.TRACKING)
    assert policy.must_yield(row("new"), [refining], False)
    assert policy.must_yield(row("new"), [from_recording], False)
    assert not policy.must_yield(row("new"), [tracking], False)
    assert not policy.must_yield(row("new", live=False), [refining], False), "it is from the queue already"
    policy.limit = 2
    assert not policy.must_yield(row("new"), [refining], False)


def test_a_live_one_returns_to_the_queue_when_a_queued_one_could_run_instead() -> None:
    policy = QueuePolicy()
    assert policy.must_yield(row("new"), [], True)
    assert not policy.must_yield(row("new"), [row("tracking", stage=Stage.TRACKING)], True), "none could start"
    policy.limit = 2
    assert policy.must_yield(row("new"), [row("tracking", stage=Stage.TRACKING)], True)


def test_retries_are_delayed_and_counted_for_each_reconstruction() -> None:
    policy = QueuePolicy(delays_s=(0.0, 3600.0))
    assert policy.due("one") and not policy.delays
    assert policy.retry("one") and policy.due("one")
    assert policy.retry("one") and policy.delays
    assert not policy.due("one") and policy.due("other")
    assert not policy.retry("one"), "there were as many retries as delays"
    policy.reset_retries("one")
    assert policy.due("one") and not policy.delays
    assert policy.retry("one"), "they are counted anew"


def test_deaths_count_however_long_the_worker_has_lived(monkeypatch: pytest.MonkeyPatch) -> None:
    policy = QueuePolicy(delays_s=(0.0, 0.0))
    now_s = time.monotonic()
    monkeypatch.setattr(time, "monotonic", lambda: now_s)
    for _ in range(2):
        assert policy.retry("poison")
        now_s += 86_400
    assert not policy.retry("poison"), "it would come back for ever"


def test_what_no_machine_has_begun_waits_for_as_long_as_it_takes(monkeypatch: pytest.MonkeyPatch) -> None:
    policy = QueuePolicy(delays_s=(0.0,))
    now_s = time.monotonic()
    monkeypatch.setattr(time, "monotonic", lambda: now_s)
    for _ in range(100):
        policy.postpone("one")
        assert policy.delays and not policy.due("one")
        now_s += 60
        assert policy.due("one")
    assert policy.retry("one"), "none of these was a death"
