"""Maps over HTTP: a recording localised, a map extended, two merged, and what cannot be."""

from typing import Any

import numpy as np
import pytest

from spiked.client import ApiError, CaptureOut, ReconstructionOptions

UNKNOWN = "01928f5c-7e2a-7c3d-8a41-0f6d2b9c5e10"


@pytest.fixture(scope="module")
def found(service: Any, done: CaptureOut, job: str) -> str:
    """A localisation of a capture in its own map."""
    started = service.client.localise(job, done.id, first_frame=50, frames=400)
    row = service.client.wait_for_reconstruction(started.id)
    assert (row.state, row.task, row.recognised, row.frames) == ("complete", "localise", True, 400), row.reason
    assert [one.reconstruction_id for one in row.maps] == [job] and (row.part.first, row.part.count) == (50, 400)
    return str(row.id)


def test_a_localisation_has_the_scene_of_the_map_and_its_own_path(service: Any, job: str, found: str) -> None:
    client = service.client
    told, path, truth = client.localisation(found), client.trajectory(found), client.trajectory(job)
    assert told.recognised and [view.frame for view in told.views] == path.frames
    assert 50 <= path.frames[0] < path.frames[-1] < 450
    np.testing.assert_allclose([view.position for view in told.views], path.positions, atol=1e-6)
    there = np.array(truth.positions)[np.searchsorted(truth.frames, path.frames)]
    size = np.linalg.norm(np.ptp(np.array(truth.positions), axis=0))
    assert np.linalg.norm(np.array(path.positions) - there, axis=1).max() < 0.2 * size
    assert len(client.scene(found)) == len(client.scene(job))
    assert client.view(found, frame=path.frames[0])[:4] == b"\x89PNG"
    assert [one.path for one in client.paths(found)] == [0]


def test_a_captures_own_result_is_not_a_localisation(service: Any, done: CaptureOut, job: str, found: str) -> None:
    assert found in service.client.capture(done.id).reconstruction_ids
    newest = service.http.get(f"captures/{done.id}/trajectory").json()
    assert newest["frames"] == service.client.trajectory(job).frames


def test_a_request_with_a_key_is_one_job(service: Any, done: CaptureOut, job: str) -> None:
    body, headers = {"capture_id": done.id, "frames": 64}, {"Idempotency-Key": "once-and-for-all"}
    answers = [service.http.post(f"reconstructions/{job}:localise", json=body, headers=headers) for _ in range(2)]
    assert [one.status_code for one in answers] == [202, 202]
    assert answers[0].json()["id"] == answers[1].json()["id"]
    assert answers[0].headers["location"] == f"/api/v1/reconstructions/{answers[0].json()['id']}"
    service.client.cancel_reconstruction(answers[0].json()["id"])
    service.client.wait_for_reconstruction(answers[0].json()["id"])


def test_what_cannot_be_done_is_refused_with_a_reason(service: Any, done: CaptureOut, job: str, found: str) -> None:
    client = service.client
    for status, part, request in (
        (404, "there is no reconstruction", lambda: client.localise(UNKNOWN, done.id)),
        (404, "there is no capture", lambda: client.localise(job, UNKNOWN)),
        (404, "there is no reconstruction", lambda: client.merge(job, UNKNOWN)),
        (404, "there is no reconstruction", lambda: client.merge(UNKNOWN, job)),
        (404, "there is no reconstruction", lambda: client.start_reconstruction(done.id, map_id=UNKNOWN)),
        (422, "merged with itself", lambda: client.merge(job, job)),
        (422, "is a localisation and no map", lambda: client.merge(job, found)),
        (422, "frames: Input should be greater", lambda: client.localise(job, done.id, frames=0)),
        (404, "has the task reconstruct: there is no localisation of it", lambda: client.localisation(job)),
        (404, "has the task localise: there is no registration of it", lambda: client.registration(found)),
        (404, "has no path 1; GET paths lists", lambda: client.trajectory(job, path=1)),
    ):
        with pytest.raises(ApiError, match=part) as refused:
            request()
        assert refused.value.status == status
    running = client.start_reconstruction(done.id, options=ReconstructionOptions(steps=100_000))
    with pytest.raises(ApiError, match="wait for its end") as refused:
        client.localise(running.id, done.id)
    assert refused.value.status == 409
    client.cancel_reconstruction(running.id)
    client.wait_for_reconstruction(running.id)


@pytest.mark.slow
def test_maps_are_merged_and_extended(service: Any, done: CaptureOut, job: str) -> None:
    client, few = service.client, ReconstructionOptions(steps=20, seed=3)
    other = client.wait_for_reconstruction(client.start_reconstruction(done.id, options=few).id)
    both = client.wait_for_reconstruction(client.merge(job, other.id).id)
    assert (both.state, both.task, both.recognised) == ("complete", "merge", True), both.reason
    assert client.registration(both.id).joined and client.registration(both.id).similarity.scale > 0
    more = client.wait_for_reconstruction(client.start_reconstruction(done.id, options=few, map_id=job).id)
    assert (more.state, more.task, more.recognised) == ("complete", "extend", True), more.reason
    for one in (both, more):
        own, second = client.paths(one.id)
        assert (own.path, second.path, own.capture_id, second.capture_id) == (0, 1, done.id, done.id)
        frames = client.trajectory(one.id, path=1).frames
        assert len(frames) == second.poses and frames[-1] - frames[0] == len(frames) - 1
