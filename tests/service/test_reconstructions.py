"""The queue of reconstructions: order, limits, and what becomes of jobs whose workers die."""

import os
import re
import signal
import threading
from pathlib import Path

import pytest
from spiked_service.base.errors import BusyError
from spiked_service.captures.archive import DataStore
from spiked_service.results.published import Published
from spiked_service.results.scene_scale import SceneScale, read_scale, write_scale
from spiked_service.results.timeline import Timeline
from spiked_service.results.versions import Publisher, at, newest
from spiked_service.settings.reconstruction_options import IntrinsicsOption, ReconstructionOptions
from spiked_service.store.catalogue import UnknownIdError
from spiked_service.store.rows import CaptureState, JobState, Plan, ReconstructionRow, Stage
from waiting import PATIENCE_S, until

from spiked.errors import ConfigurationError

from .survival import SMALL, ended, jobs_of, over, random_recording, still_recording

SHORT = ReconstructionOptions(steps=5)
LONG = ReconstructionOptions(steps=200_000)


def running(data_store: DataStore, job: ReconstructionRow) -> int:
    """Process id of its worker, once it works."""
    until(lambda: data_store.reconstructions.rows.get(job.id).frames > 0, f"{job.id} runs")
    return data_store.reconstructions.processes()[job.id]


def edited(data_store: DataStore, job: ReconstructionRow) -> ReconstructionRow:
    """The reconstruction with another version, whose files take long to write."""
    rows = data_store.reconstructions.rows
    writes, go_on = threading.Event(), threading.Event()

    def slow(publisher: Publisher) -> Published:
        writes.set()
        assert go_on.wait(PATIENCE_S)
        return publisher.again(publisher.versions[-1])

    thread = threading.Thread(target=rows.publish_edit, args=(job.id, job.version, slow))
    thread.start()
    assert writes.wait(PATIENCE_S)
    assert rows.get(job.id).version == job.version and rows.page().items, "others read meanwhile"
    for refused in (data_store.reconstructions.restart, data_store.reconstructions.remove):
        with pytest.raises(BusyError, match="is being written"):
            refused(job.id)
    with pytest.raises(BusyError, match="is being written"):
        rows.publish_edit(job.id, job.version, slow)
    assert thread.is_alive()
    go_on.set()
    thread.join()
    assert rows.get(job.id).version == job.version + 1
    return rows.get(job.id)


def test_a_recording_is_reconstructed_with_versions_and_timeline(house: tuple[DataStore, str]) -> None:
    data_store, capture_id = house
    done = ended(data_store, data_store.reconstructions.submit(capture_id, SHORT))
    assert (done.state, done.frames, done.live, done.attempts) == (JobState.COMPLETE, 500, False, 1)
    assert done.started_at is not None and done.ended_at is not None
    timeline = Timeline.read(data_store.reconstructions.rows.timeline(done.id))
    assert len(timeline.moments) > 10
    assert timeline.moments["rate"][-1] > 0
    published = newest(data_store.reconstructions.rows.folder(done.id))
    listed = data_store.reconstructions.rows.versions(done.id)
    assert published is not None and published.version == done.version == listed[-1].version
    assert done.white == published.white and done.poses == published.poses > 400
    done = edited(data_store, done)
    folder = data_store.reconstructions.rows.folder(done.id)
    write_scale(folder, SceneScale(metres_per_unit=2.0, version=done.version))
    again = data_store.reconstructions.restart(done.id, ReconstructionOptions(steps=0))
    assert again.id == done.id and again.state is JobState.QUEUED
    finished = ended(data_store, again)
    assert finished.options.steps == 0
    assert finished.version > done.version
    scale = read_scale(folder)
    assert (scale.revision, scale.metres_per_unit, scale.since) == (2, None, done.version), "the unit is another one"
    data_store.reconstructions.remove(done.id)
    with pytest.raises(UnknownIdError):
        data_store.reconstructions.rows.get(done.id)
    assert done.id not in data_store.folder.contents()[1]


def test_a_reconstruction_without_a_path_has_failed_and_says_why(house: tuple[DataStore, str], tmp_path: Path) -> None:
    """From a recording and live: 'complete' with 0 poses said that all was well."""
    data_store, _ = house
    source = f"replay:{still_recording(tmp_path / 'still.dat')}?pace=0"
    live = over(data_store, data_store.captures.start(Plan(source, options=SHORT)).id)
    again = ended(data_store, data_store.reconstructions.submit(live.row.id, SHORT))
    for job in (*jobs_of(data_store, live.id)[:1], again):
        assert (job.state, job.poses, job.version) == (JobState.FAILED, 0, 0)
        assert job.reason.startswith("the camera stood still"), job.reason
    assert live.row.state is CaptureState.COMPLETE and live.row.warnings == (again.reason,)
    unrecorded = over(data_store, data_store.captures.start(Plan(source, options=SHORT, record=False)).id).row
    assert unrecorded.state is CaptureState.FAILED and unrecorded.reason == again.reason


def test_one_that_is_ended_early_ends_with_the_best_version_that_there_is(house: tuple[DataStore, str]) -> None:
    data_store, capture_id = house
    good = ended(data_store, data_store.reconstructions.submit(capture_id, ReconstructionOptions(steps=600)))
    data_store.reconstructions.restart(good.id, LONG)
    until(lambda: data_store.reconstructions.rows.get(good.id).stage == Stage.REFINING, "it is refined")
    data_store.reconstructions.finish_early(good.id)
    row = ended(data_store, good)
    assert row.state is JobState.COMPLETE and row.version > good.version
    found = re.search(
        r"version (\d+) matches the recording better than the last one and is published again$", row.reason
    )
    assert found is not None, row.reason
    best = int(found[1])
    assert best <= good.version  # on a slow machine the first run publishes versions, one of which may be the best
    folder = data_store.reconstructions.rows.folder(good.id)
    before, after = at(folder, best), newest(folder)
    assert before is not None and after is not None and after.version == row.version
    assert (row.splats, row.poses, row.psnr_db) == (before.splats, before.poses, before.psnr_db)
    assert (folder / before.scene).read_bytes() == (folder / after.scene).read_bytes()
    data_store.reconstructions.remove(good.id)


def test_one_at_a_time_the_most_important_first(house: tuple[DataStore, str]) -> None:
    data_store, capture_id = house
    blocking = data_store.reconstructions.submit(capture_id, LONG)
    running(data_store, blocking)
    jobs = [data_store.reconstructions.submit(capture_id, SHORT, priority=priority) for priority in (0, 5, 5, -1)]
    assert [data_store.reconstructions.rows.get(job.id).state for job in jobs] == [JobState.QUEUED] * 4
    with pytest.raises(BusyError, match="cancel it"):
        data_store.reconstructions.restart(jobs[0].id)
    dropped = data_store.reconstructions.cancel(jobs[2].id)
    assert dropped.state is JobState.CANCELLED
    with pytest.raises(BusyError, match="cancel it first"):
        data_store.reconstructions.remove(blocking.id)
    data_store.reconstructions.cancel(blocking.id)
    assert ended(data_store, blocking).state is JobState.CANCELLED
    rows = [ended(data_store, job) for job in jobs]
    begun = {row.id: row.started_at for row in rows if row.started_at is not None}
    assert sorted(begun, key=lambda key: begun[key]) == [jobs[1].id, jobs[0].id, jobs[3].id]
    assert data_store.reconstructions.rows.counts()[JobState.RUNNING] == 0


def test_a_live_reconstruction_does_not_wait_and_the_queue_waits_for_it(house: tuple[DataStore, str]) -> None:
    data_store, capture_id = house
    live = data_store.captures.start(Plan(f"{SMALL}&seed=7", options=SHORT))
    until(lambda: jobs_of(data_store, live.id), "the live one runs")
    queued = data_store.reconstructions.submit(capture_id, SHORT)
    until(lambda: jobs_of(data_store, live.id)[0].frames > 200, "it takes frames")
    assert data_store.reconstructions.rows.get(queued.id).state is JobState.QUEUED
    data_store.captures.stop(live.id)
    assert jobs_of(data_store, over(data_store, live.id).id)[0].live
    assert ended(data_store, queued).state is JobState.COMPLETE


def test_a_job_whose_worker_dies_is_begun_again_and_given_up_in_the_end(house: tuple[DataStore, str]) -> None:
    data_store, capture_id = house
    job = data_store.reconstructions.submit(capture_id, LONG)
    for attempt in (1, 2, 3):
        until(lambda: data_store.reconstructions.rows.get(job.id).attempts == attempt, "it is tried again")  # noqa: B023
        os.kill(running(data_store, job), signal.SIGKILL)
        until(lambda: job.id not in data_store.reconstructions.processes(), "it is dead")
        if attempt < 3:
            row = data_store.reconstructions.rows.get(job.id)
            assert row.attempts > attempt or row.reason.startswith("the reconstruction worker was killed by signal 9")
    row = ended(data_store, job)
    assert row.state is JobState.FAILED
    assert row.reason == "the reconstruction worker was killed by signal 9, the last of 3 attempts"


def test_what_cannot_be_reconstructed_is_refused_at_once(house: tuple[DataStore, str], tmp_path: Path) -> None:
    data_store, _ = house
    with pytest.raises(UnknownIdError):
        data_store.reconstructions.submit("nothing", SHORT)
    random_recording(tmp_path / "noise.dat", 64)
    plan = Plan(f"replay:{tmp_path / 'noise.dat'}?pace=0", reconstruct=False)
    blind = over(data_store, data_store.captures.start(plan).id)
    assert ended(
        data_store, data_store.reconstructions.submit(blind.id, SHORT)
    ).state.over  # the focal length is estimated
    seeing = ReconstructionOptions(steps=0, intrinsics=IntrinsicsOption(fx=80, fy=80, cx=48, cy=32))
    noise = ended(data_store, data_store.reconstructions.submit(blind.id, seeing))
    assert noise.state is JobState.FAILED and "too short" in noise.reason
    data_store.captures.removal.remove(blind.id)
    with pytest.raises(ConfigurationError, match="is deleted"):
        data_store.reconstructions.submit(blind.id, seeing)


def test_a_job_for_a_capture_that_still_records_waits_for_its_end(house: tuple[DataStore, str]) -> None:
    data_store, _ = house
    capture = data_store.captures.start(Plan(f"{SMALL}&seed=9", reconstruct=False))
    until(lambda: data_store.captures.get(capture.id).counters is not None, "it runs")
    job = data_store.reconstructions.submit(capture.id, SHORT)
    assert job.state is JobState.QUEUED
    until(lambda: data_store.captures.get(capture.id).counters.received > 400, "frames come")  # type: ignore[union-attr]
    assert data_store.reconstructions.rows.get(job.id).state is JobState.QUEUED
    data_store.captures.stop(capture.id)
    done = ended(data_store, job)
    assert done.frames == data_store.captures.get(capture.id).row.recording.frames  # type: ignore[union-attr]
    recording = data_store.captures.get(capture.id).row.recording
    assert recording is not None and done.frames == recording.frames
