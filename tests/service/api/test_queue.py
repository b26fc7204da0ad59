"""The queue of reconstructions over HTTP: names, holding and moving."""

import time
from collections.abc import Iterator
from typing import Any

import pytest
from waiting import until

from spiked.client import ApiError, CaptureOut, ReconstructionOptions, ReconstructionOut


@pytest.fixture
def waiting(service: Any, done: CaptureOut) -> Iterator[list[str]]:
    """Three queued reconstructions behind a long one that runs, in the order of their turns."""
    client = service.client
    options = ReconstructionOptions(steps=100_000)
    ids = [client.start_reconstruction(done.id, options=options).id]
    until(lambda: client.reconstruction(ids[0]).state == "running", "the first runs")
    ids += [client.start_reconstruction(done.id, options=options).id for _ in range(3)]
    yield ids[1:]
    for one in reversed(ids):
        if client.reconstruction(one).state in ("queued", "running"):
            client.cancel_reconstruction(one)
    for one in ids:
        client.wait_for_reconstruction(one, 120)
        client.remove_reconstruction(one)


def order(service: Any, ids: list[str]) -> list[str]:
    """Of the queued ones, by their places."""
    found: list[ReconstructionOut] = [service.client.reconstruction(one) for one in ids]
    assert sorted(one.queue_place for one in found if one.queue_place) == [*range(1, len(ids) + 1)]
    return [one.id for one in sorted(found, key=lambda one: one.queue_place or 0)]


def test_queued_ones_are_moved(service: Any, waiting: list[str]) -> None:
    a, b, c = waiting
    change = service.client.change_reconstruction
    assert order(service, waiting) == [a, b, c]
    assert change(c, queue_place=1).queue_place == 1
    assert order(service, waiting) == [c, a, b]
    assert change(c, queue_place=99).queue_place == 3
    assert order(service, waiting) == [a, b, c]
    urgent = service.client.start_reconstruction(service.client.reconstruction(a).capture_id, priority=5).id
    assert order(service, [*waiting, urgent]) == [urgent, a, b, c]
    change(urgent, queue_place=3)
    assert order(service, [*waiting, urgent]) == [a, b, urgent, c]
    assert service.client.reconstruction(urgent).priority == 0, "it has the place, and with it the priority"
    listed = service.http.get("reconstructions", params={"in_turn": True, "limit": 3}).json()
    assert ([one["id"] for one in listed["items"]], listed["total"]) == ([a, b, urgent], 4)
    assert service.http.get("reconstructions", params={"in_turn": True, "state": "running"}).status_code == 422
    service.client.cancel_reconstruction(urgent)
    service.client.remove_reconstruction(urgent)


def test_a_held_one_stays_in_the_queue_until_it_is_let_go(service: Any, waiting: list[str]) -> None:
    client = service.client
    a, b, _ = waiting
    held = client.change_reconstruction(a, held=True)
    assert held.held and held.queue_place == 1 and held.eta_s is None
    running = next(one.id for one in client.reconstructions() if one.state == "running")
    client.cancel_reconstruction(running)
    until(lambda: client.reconstruction(b).state == "running", "the one behind it goes first")
    assert client.reconstruction(a).state == "queued"
    client.cancel_reconstruction(b)
    client.cancel_reconstruction(waiting[2])
    client.wait_for_reconstruction(b, 120)
    time.sleep(1.5)
    assert client.reconstruction(a).state == "queued", "though nothing else runs"
    client.change_reconstruction(a, held=False)
    until(lambda: client.reconstruction(a).state == "running", "let go, it begins")


def test_names_and_notes_stay_whatever_becomes_of_it(service: Any, waiting: list[str]) -> None:
    client = service.client
    running = next(one.id for one in client.reconstructions() if one.state == "running")
    for one in (running, waiting[0]):
        named = client.change_reconstruction(one, name="sharp", notes="100,000 steps")
        assert (named.name, named.notes) == ("sharp", "100,000 steps")
    frames = client.reconstruction(running).frames
    until(lambda: client.reconstruction(running).frames > frames or client.reconstruction(running).progress, "it works")
    client.cancel_reconstruction(running)
    assert client.wait_for_reconstruction(running, 120).name == "sharp"
    until(lambda: client.reconstruction(waiting[0]).state == "running", "its turn")
    found = client.change_reconstruction(waiting[0], notes="")
    assert (found.name, found.notes) == ("sharp", "")
    with pytest.raises(ApiError, match="only those that wait in the queue") as refused:
        client.change_reconstruction(waiting[0], queue_place=1)
    assert refused.value.status == 409
    answer = service.http.patch(f"reconstructions/{waiting[0]}", json={"queue_place": 0})
    assert answer.status_code == 422


def test_one_that_runs_is_paused_and_goes_on_where_it_was(service: Any, waiting: list[str]) -> None:
    client = service.client
    running = next(one.id for one in client.reconstructions() if one.state == "running")
    until(lambda: client.reconstruction(running).progress > 0.001, "it refines")
    client.change_reconstruction(running, held=True, notes="later")
    until(lambda: client.reconstruction(running).state == "queued", "it is back in the queue")
    paused = client.reconstruction(running)
    assert paused.held and paused.notes == "later" and paused.progress > 0.001 and paused.reason == ""
    until(lambda: client.reconstruction(waiting[0]).state == "running", "the next one runs meanwhile")
    for one in waiting:
        client.cancel_reconstruction(one)
    client.change_reconstruction(running, held=False)
    until(lambda: client.reconstruction(running).state == "running", "it goes on")
    until(lambda: client.reconstruction(running).stage == "refining", "where it was")
    assert client.reconstruction(running).progress >= paused.progress / 2, "a checkpoint is some seconds old at most"
    client.cancel_reconstruction(running)


def test_one_that_follows_its_capture_cannot_be_paused(service: Any) -> None:
    capture = service.client.start_capture("sim:?width=64&height=48", record=False)
    until(lambda: service.client.capture(capture.id).reconstruction_ids, "its reconstruction has begun")
    (live,) = service.client.capture(capture.id).reconstruction_ids
    with pytest.raises(ApiError, match="follows its capture") as refused:
        service.client.change_reconstruction(live, held=True)
    assert refused.value.status == 409
    service.client.stop_capture(capture.id)
    service.client.stop_capture(capture.id)
    service.client.wait_for_capture(capture.id, 120)
