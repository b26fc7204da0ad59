"""The queue of reconstructions: order, limits, and what becomes of jobs whose workers die."""

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from spiked_service.errors import BusyError
from spiked_service.keeping import Keeping
from spiked_service.publication import newest
from spiked_service.reconstruction_options import IntrinsicsOption, ReconstructionOptions
from spiked_service.store.catalogue import UnknownIdError
from spiked_service.store.rows import JobState, Plan, ReconstructionRow
from spiked_service.timeline import Timeline

from spiked.errors import ConfigurationError

from .survival import SMALL, kept, over, random_recording, wait_for

SHORT = ReconstructionOptions(steps=5)
LONG = ReconstructionOptions(steps=200_000)


@pytest.fixture(scope="module")
def house(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Keeping, str]]:
    """A service, and a capture of it that has a recording and no reconstruction."""
    with kept(tmp_path_factory.mktemp("house") / "data") as keeping:
        plan = Plan(f"{SMALL}&pace=0", frames=500, reconstruct=False)
        yield keeping, over(keeping, keeping.captures.start(plan).id).id


def ended(keeping: Keeping, job: ReconstructionRow) -> ReconstructionRow:
    wait_for(lambda: keeping.reconstructions.get(job.id).state.over, f"{job.id} is over")
    return keeping.reconstructions.get(job.id)


def running(keeping: Keeping, job: ReconstructionRow) -> int:
    """Process id of its worker, once it works."""
    wait_for(lambda: keeping.reconstructions.get(job.id).frames > 0, f"{job.id} runs")
    return keeping.reconstructions.processes()[job.id]


def test_a_recording_is_reconstructed_with_versions_and_timeline(house: tuple[Keeping, str]) -> None:
    keeping, capture_id = house
    done = ended(keeping, keeping.reconstructions.submit(capture_id, SHORT))
    assert (done.state, done.frames, done.live, done.attempts) == (JobState.COMPLETE, 500, False, 1)
    assert done.started_at is not None and done.ended_at is not None
    timeline = Timeline.read(keeping.reconstructions.timeline(done.id))
    assert len(timeline.moments) > 10
    assert timeline.moments[-1].rate is not None and timeline.moments[-1].rate > 0
    published = newest(keeping.reconstructions.folder(done.id))
    listed = keeping.reconstructions.versions(done.id)
    if done.version:
        assert published is not None and published.version == done.version == listed[-1].version
        assert done.white == published.white and done.poses == published.poses
    again = keeping.reconstructions.restart(done.id, ReconstructionOptions(steps=0))
    assert again.id == done.id and again.state is JobState.QUEUED
    finished = ended(keeping, again)
    assert finished.options.steps == 0
    assert finished.version >= done.version
    keeping.reconstructions.remove(done.id)
    with pytest.raises(UnknownIdError):
        keeping.reconstructions.get(done.id)
    assert done.id not in keeping.folder.contents()[1]


def test_one_at_a_time_the_most_important_first(house: tuple[Keeping, str]) -> None:
    keeping, capture_id = house
    blocking = keeping.reconstructions.submit(capture_id, LONG)
    running(keeping, blocking)
    jobs = [keeping.reconstructions.submit(capture_id, SHORT, priority=priority) for priority in (0, 5, 5, -1)]
    assert [keeping.reconstructions.get(job.id).state for job in jobs] == [JobState.QUEUED] * 4
    with pytest.raises(BusyError, match="cancel it"):
        keeping.reconstructions.restart(jobs[0].id)
    dropped = keeping.reconstructions.cancel(jobs[2].id)
    assert dropped.state is JobState.CANCELLED
    with pytest.raises(BusyError, match="cancel it first"):
        keeping.reconstructions.remove(blocking.id)
    keeping.reconstructions.cancel(blocking.id)
    assert ended(keeping, blocking).state is JobState.CANCELLED
    rows = [ended(keeping, job) for job in jobs]
    begun = {row.id: row.started_at for row in rows if row.started_at is not None}
    assert sorted(begun, key=lambda key: begun[key]) == [jobs[1].id, jobs[0].id, jobs[3].id]
    assert keeping.reconstructions.counts()[JobState.RUNNING] == 0


def test_a_live_reconstruction_does_not_wait_and_the_queue_waits_for_it(house: tuple[Keeping, str]) -> None:
    keeping, capture_id = house
    live = keeping.captures.start(Plan(f"{SMALL}&seed=7", options=SHORT))
    wait_for(lambda: keeping.captures.get(live.id).reconstructions, "the live one runs")
    queued = keeping.reconstructions.submit(capture_id, SHORT)
    wait_for(lambda: keeping.captures.get(live.id).reconstructions[0].frames > 200, "it takes frames")
    assert keeping.reconstructions.get(queued.id).state is JobState.QUEUED
    keeping.captures.stop(live.id)
    assert over(keeping, live.id).reconstructions[0].live
    assert ended(keeping, queued).state is JobState.COMPLETE


def test_a_job_whose_worker_dies_is_begun_again_and_given_up_in_the_end(house: tuple[Keeping, str]) -> None:
    keeping, capture_id = house
    job = keeping.reconstructions.submit(capture_id, LONG)
    for attempt in (1, 2, 3):
        wait_for(lambda: keeping.reconstructions.get(job.id).attempts == attempt, "it is tried again")  # noqa: B023
        os.kill(running(keeping, job), signal.SIGKILL)
        wait_for(lambda: job.id not in keeping.reconstructions.processes(), "it is dead")
        if attempt < 3:
            row = keeping.reconstructions.get(job.id)
            assert row.attempts > attempt or row.reason.startswith("the reconstruction worker was killed by signal 9")
    row = ended(keeping, job)
    assert row.state is JobState.FAILED
    assert row.reason == "the reconstruction worker was killed by signal 9, the last of 3 attempts"


def test_what_cannot_be_reconstructed_is_refused_at_once(house: tuple[Keeping, str], tmp_path: Path) -> None:
    keeping, _ = house
    with pytest.raises(UnknownIdError):
        keeping.reconstructions.submit("nothing", SHORT)
    random_recording(tmp_path / "noise.dat", 64)
    plan = Plan(f"replay:{tmp_path / 'noise.dat'}?pace=0", reconstruct=False)
    blind = over(keeping, keeping.captures.start(plan).id)
    assert ended(keeping, keeping.reconstructions.submit(blind.id, SHORT)).state.over  # the focal length is estimated
    seeing = ReconstructionOptions(steps=0, intrinsics=IntrinsicsOption(fx=80, fy=80, cx=48, cy=32))
    assert ended(keeping, keeping.reconstructions.submit(blind.id, seeing)).state is JobState.COMPLETE
    keeping.captures.remove(blind.id)
    with pytest.raises(ConfigurationError, match="is deleted"):
        keeping.reconstructions.submit(blind.id, seeing)


def test_a_job_for_a_capture_that_still_records_waits_for_its_end(house: tuple[Keeping, str]) -> None:
    keeping, _ = house
    capture = keeping.captures.start(Plan(f"{SMALL}&seed=9", reconstruct=False))
    wait_for(lambda: keeping.captures.get(capture.id).counters is not None, "it runs")
    job = keeping.reconstructions.submit(capture.id, SHORT)
    assert job.state is JobState.QUEUED
    wait_for(lambda: keeping.captures.get(capture.id).counters.received > 400, "frames come")  # type: ignore[union-attr]
    assert keeping.reconstructions.get(job.id).state is JobState.QUEUED
    keeping.captures.stop(capture.id)
    done = ended(keeping, job)
    assert done.state is JobState.COMPLETE
    recording = keeping.captures.get(capture.id).row.recording
    assert recording is not None and done.frames == recording.frames
