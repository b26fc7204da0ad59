"""Reconstructions from recordings, taken up where a killed worker or service left them."""

import os
import signal
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from spiked_service.base.ids import new_id
from spiked_service.captures.archive import DataStore
from spiked_service.reconstructions.job_runner import queued_again
from spiked_service.results.recording_feed import reconstruct_recording
from spiked_service.results.timeline import Timeline
from spiked_service.results.versions import newest, pose_file
from spiked_service.settings.reconstruction_options import ReconstructionOptions
from spiked_service.store.rows import JobState, Plan, ReconstructionRow, Stage
from waiting import until

from spiked.poses import PoseFile
from spiked.recon import Reconstructor
from spiked.recon.checkpoint import CheckpointSaver, Interrupted
from spiked.recon.checkpoint_file import exists
from spiked.recording import open_recording

from .survival import ended, kept, moving_recording, over
from .test_recovery import service

SHORT = ReconstructionOptions(steps=20)
LONG = ReconstructionOptions(steps=200_000)


class KilledError(Exception):
    """The end of a worker, as seen from within."""


def left_behind(data_store: DataStore, job: ReconstructionRow, frames: int) -> None:
    """Leave the checkpoint of a worker that was killed after so many frames."""
    recording = open_recording(data_store.folder.recording(job.capture_id))
    parameters = {"options": job.options.model_dump(mode="json"), "intrinsics": None}
    assert recording.sensor.intrinsics is not None
    k = recording.sensor.intrinsics
    parameters["intrinsics"] = {"fx": k.fx, "fy": k.fy, "cx": k.cx, "cy": k.cy, "distortion": None}
    reconstructor = Reconstructor(recording.sensor, job.options.options(), recording=recording)
    saver = CheckpointSaver(data_store.folder.checkpoint(job.id), recording, parameters, pytest.fail)

    def save() -> None:
        if reconstructor.frames >= frames:
            saver.save(reconstructor, now=True)
            raise KilledError

    with pytest.raises(KilledError):
        reconstruct_recording(
            recording, reconstructor, progress=lambda status: None, cancelled=lambda: False, save=save
        )
    saver.close()


def log_of(data_store: DataStore, job: ReconstructionRow) -> str:
    return data_store.reconstructions.rows.log(job.id).read_text()


def poses(data_store: DataStore, job: ReconstructionRow) -> np.ndarray:
    folder = data_store.reconstructions.rows.folder(job.id)
    published = newest(folder)
    assert published is not None
    file = PoseFile(pose_file(folder, published))
    return file.trajectory(range(len(file))).centres


@pytest.mark.parametrize("options", ["the same", pytest.param("others", marks=pytest.mark.slow)])
def test_a_job_goes_on_from_the_checkpoint_of_its_tracking(house: tuple[DataStore, str], options: str) -> None:
    data_store, capture_id = house
    whole = ended(data_store, data_store.reconstructions.submit(capture_id, SHORT))
    blocking = data_store.reconstructions.submit(capture_id, LONG)
    job = data_store.reconstructions.submit(capture_id, SHORT)
    left_behind(data_store, job, 256)
    if options == "others":
        data_store.reconstructions.rows.save(
            ReconstructionRow(
                job.id, capture_id, False, JobState.QUEUED, job.created_at, options=ReconstructionOptions(steps=21)
            )
        )
    data_store.reconstructions.cancel(blocking.id)
    done = ended(data_store, job)
    assert (done.state, done.frames, done.reason) == (JobState.COMPLETE, 500, "")
    assert not data_store.folder.checkpoint(job.id).exists()
    moments = [Timeline.read(data_store.reconstructions.rows.timeline(one.id)).moments for one in (done, whole)]
    np.testing.assert_array_equal(moments[0]["frame"], moments[1]["frame"])
    if options == "others":
        assert "begins anew" in log_of(data_store, job)
    else:
        assert "resumed from its checkpoint" in log_of(data_store, job)
        np.testing.assert_array_equal(poses(data_store, done), poses(data_store, whole))


def refining_with_checkpoint(data_store: DataStore, job_id: str) -> None:
    def there() -> bool:
        row, folder = data_store.reconstructions.rows.get(job_id), data_store.folder.checkpoint(job_id)
        return row.stage is Stage.REFINING and exists(folder) and Interrupted.read(folder).state.header["progress"] > 0

    until(there, "it refines and has left a checkpoint")


def test_a_job_whose_worker_is_killed_goes_on(house: tuple[DataStore, str]) -> None:
    data_store, capture_id = house
    job = data_store.reconstructions.submit(capture_id, LONG)
    refining_with_checkpoint(data_store, job.id)
    os.kill(data_store.reconstructions.processes()[job.id], signal.SIGKILL)
    until(lambda: data_store.reconstructions.rows.get(job.id).state is JobState.QUEUED, "it is queued again")
    assert "; resumed from its checkpoint (attempt 2)" in data_store.reconstructions.rows.get(job.id).reason
    saved = Interrupted.read(data_store.folder.checkpoint(job.id)).state.header["progress"]
    until(lambda: data_store.reconstructions.rows.get(job.id).progress >= saved, "it is where it was")
    assert "resumed from its checkpoint: refining" in log_of(data_store, job)
    used = data_store.folder.checkpoint(job.id)
    assert sum(path.stat().st_size for path in used.iterdir()) > 100_000
    data_store.reconstructions.finish_early(job.id)
    done = ended(data_store, job)
    assert (done.state, done.attempts) == (JobState.COMPLETE, 2)
    assert not used.exists()


def test_a_cancelled_job_leaves_no_checkpoint(house: tuple[DataStore, str]) -> None:
    data_store, capture_id = house
    blocking = data_store.reconstructions.submit(capture_id, LONG)
    job = data_store.reconstructions.submit(capture_id, SHORT)
    left_behind(data_store, job, 128)
    data_store.reconstructions.cancel(job.id)
    assert not data_store.folder.checkpoint(job.id).exists()
    data_store.reconstructions.cancel(blocking.id)
    assert ended(data_store, blocking).state is JobState.CANCELLED


@pytest.mark.slow
@pytest.mark.parametrize("end", ["killed", "ended"])
def test_jobs_of_a_killed_service_go_on(tmp_path: Path, end: str) -> None:
    data, source = tmp_path / "data", f"replay:{moving_recording(tmp_path / 'moving.dat')}?pace=0"
    with kept(data) as data_store:
        capture = over(data_store, data_store.captures.start(Plan(source, reconstruct=False)).id)
        job = data_store.reconstructions.submit(capture.id, LONG)
        if end == "ended":
            refining_with_checkpoint(data_store, job.id)
    if end == "killed":
        with service(data) as one:
            state = data / "reconstructions" / job.id / "checkpoint" / "state"
            until(lambda: state.exists() and Interrupted.read(state.parent).state.header["progress"] > 0, "saved")
            one.kill()
    saved = Interrupted.read(data / "reconstructions" / job.id / "checkpoint").state.header["progress"]
    assert saved > 0
    with kept(data) as data_store:
        until(lambda: data_store.reconstructions.rows.get(job.id).progress >= saved, "it is where it was")
        assert "resumed from its checkpoint: refining" in log_of(data_store, job)
        data_store.reconstructions.cancel(job.id)
        assert ended(data_store, job).state is JobState.CANCELLED
        assert not data_store.folder.checkpoint(job.id).exists()


def test_restarts_of_the_service_are_no_attempts(tmp_path: Path) -> None:
    data, source = tmp_path / "data", f"replay:{moving_recording(tmp_path / 'moving.dat')}?pace=0"
    with kept(data) as data_store:
        capture = over(data_store, data_store.captures.start(Plan(source, reconstruct=False)).id)
        job = data_store.reconstructions.submit(capture.id, LONG)
    for _ in range(2):
        with kept(data) as data_store:
            until(lambda: data_store.reconstructions.rows.get(job.id).state is JobState.RUNNING, "it runs")
            assert data_store.reconstructions.rows.get(job.id).attempts == 1


def test_a_job_that_ended_or_waits_has_no_time_left_of_its_run(tmp_path: Path) -> None:
    source = f"replay:{moving_recording(tmp_path / 'video.dat')}"
    with kept(tmp_path / "data") as data_store:
        capture = over(data_store, data_store.captures.start(Plan(source, reconstruct=False)).id)
        left = ReconstructionRow(new_id(), capture.id, False, JobState.RUNNING, datetime.now(UTC), eta_s=99.0)
        assert queued_again(left, "").eta_s is None
        assert data_store.reconstructions.rows.save(replace(left, state=JobState.FAILED)).eta_s is None
        assert data_store.catalogue.reconstructions.get(left.id).eta_s is None
