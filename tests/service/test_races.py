"""Requests that come between the steps of others, and failures between two writes: nothing is lost or done twice."""

from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from spiked_service.api.idempotency import Answer, IdempotencyKeys
from spiked_service.api.problems import ConflictError
from spiked_service.base.errors import BusyError
from spiked_service.base.ids import new_id
from spiked_service.captures.archive import DataStore
from spiked_service.captures.uploads import Uploads
from spiked_service.results.versions import Publisher, versions
from spiked_service.store.catalogue import StoreError
from spiked_service.store.retention import Policy
from spiked_service.store.rows import (
    CaptureRow,
    CaptureState,
    Grade,
    JobState,
    Origin,
    Plan,
    Quality,
    ReconstructionRow,
    Recorded,
    UploadRow,
)
from waiting import until

from spiked.scene import Scene
from spiked.trajectory import Trajectory

from .survival import SMALL, kept, over

NOW = datetime(2026, 11, 25, tzinfo=UTC)
MIB = 1 << 20


@pytest.fixture
def data_store(tmp_path: Path) -> Iterator[DataStore]:
    with kept(tmp_path / "data") as one:
        yield one


def stored(data_store: DataStore, *jobs: JobState, **more: Any) -> CaptureRow:
    """An ended capture with a recording of 1 MiB and reconstructions in these states."""
    row = replace(CaptureRow(new_id(), Origin.LIVE, Plan("sim:"), CaptureState.COMPLETE, NOW, ended_at=NOW), **more)
    data_store.catalogue.captures.put(row)
    data_store.folder.capture(row.id).mkdir()
    data_store.folder.recording(row.id).write_bytes(bytes(MIB))
    for state in jobs:
        data_store.catalogue.reconstructions.put(ReconstructionRow(new_id(), row.id, False, state, NOW))
    return row


def test_retention_spares_what_was_kept_or_restored_meanwhile(
    data_store: DataStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, restored, wanted = (stored(data_store, deleted_at=at) for at in (NOW, NOW, None))
    begin = data_store.captures.purging.begin

    def slow(capture_id: str) -> None:
        begin(capture_id)
        data_store.catalogue.captures.set(restored.id, deleted_at=None)
        data_store.catalogue.captures.set(wanted.id, keep=True)

    monkeypatch.setattr(data_store.captures.purging, "begin", slow)
    data_store.retention.policy = Policy(bytes=0)
    data_store.retention.apply(NOW)
    there = [data_store.catalogue.captures.find(one.id) is not None for one in (first, restored, wanted)]
    assert there == [False, True, True]


def test_a_running_job_spares_its_capture_and_no_other(data_store: DataStore) -> None:
    busy = stored(data_store, JobState.COMPLETE, JobState.RUNNING)
    idle = stored(data_store, JobState.COMPLETE)
    data_store.retention.policy = Policy(bytes=0)
    data_store.retention.apply(NOW)
    assert data_store.catalogue.captures.find(idle.id) is None
    assert data_store.catalogue.captures.find(busy.id) is not None
    assert [row.state for row in data_store.catalogue.reconstruction_page(capture_id=busy.id).items[::-1]] == [
        JobState.COMPLETE,
        JobState.RUNNING,
    ]


def test_a_device_that_is_armed_meanwhile_is_not_started(
    data_store: DataStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    size_of = data_store.captures._new.size_of

    def slow(plan: Plan) -> int | None:
        data_store.captures.arm(SMALL, 0.1)
        return size_of(plan)

    monkeypatch.setattr(data_store.captures._new, "size_of", slow)
    with pytest.raises(BusyError, match="armed or disarmed meanwhile"):
        data_store.captures.start(Plan(SMALL, reconstruct=False))
    assert list(data_store.captures.list().items) == [] and len(data_store.captures.armed()) == 1
    data_store.captures.disarm(SMALL)


def test_a_triggered_capture_without_a_recording_ends(data_store: DataStore) -> None:
    data_store.captures.arm(SMALL, 0.1)
    armed_device = next(iter(data_store.captures.armed().values()))
    until(lambda: (counters := armed_device.counters()) and counters.next_frame > 100, "it is armed")
    started = data_store.captures.start(Plan(SMALL, record=False, frames=50))
    done = over(data_store, started.id)
    assert done.row.state in (CaptureState.COMPLETE, CaptureState.FAILED)
    assert not data_store.captures.live()


def test_a_refused_change_of_a_live_capture_is_not_shown(
    data_store: DataStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    capture_id = data_store.captures.start(Plan(SMALL, reconstruct=False)).id
    put = data_store.catalogue.captures.put

    def full(row: CaptureRow) -> None:
        if row.notes:
            raise StoreError("the disk is full")
        put(row)

    monkeypatch.setattr(data_store.catalogue.captures, "put", full)
    with pytest.raises(StoreError):
        data_store.captures.update(capture_id, notes="mine")
    assert data_store.captures.get(capture_id).row.notes == ""
    data_store.captures.stop(capture_id)
    over(data_store, capture_id)


def test_a_recording_that_was_closed_stays_good_after_a_kill(tmp_path: Path) -> None:
    """The service was killed while the reconstruction refined: the recorder had ended long before."""
    with kept(tmp_path / "data") as data_store:
        row = stored(
            data_store,
            state=CaptureState.FINISHING,
            recording=Recorded(7, 700),
            verdict=Quality(Grade.GOOD, ()),
            ended_at=None,
        )
    with kept(tmp_path / "data") as data_store:
        until(lambda: data_store.captures.get(row.id).row.state.over, "it is ended")
        now = data_store.captures.get(row.id).row
        assert (now.recording, now.verdict) == (Recorded(7, 700), Quality(Grade.GOOD, ()))


def test_a_result_whose_files_are_gone_is_not_called_complete(tmp_path: Path) -> None:
    """A catalogue was restored that is older than the deletion of a reconstruction."""
    with kept(tmp_path / "data") as data_store:
        row = stored(data_store)
        job = ReconstructionRow(new_id(), row.id, False, JobState.COMPLETE, NOW, version=1)
        data_store.catalogue.reconstructions.put(job)
    with kept(tmp_path / "data") as data_store:
        until(lambda: data_store.reconstructions.rows.get(job.id).state is JobState.FAILED, "it is told")
        now = data_store.reconstructions.rows.get(job.id)
        assert "its files are gone" in now.reason and now.version == 0
        assert data_store.reconstructions.rows.versions(job.id) == []


def test_versions_whose_files_are_damaged_are_not_listed_after_a_start(tmp_path: Path) -> None:
    trajectory = Trajectory(np.array([0.5]), np.eye(3)[None], np.zeros((1, 3)))
    with kept(tmp_path / "data") as data_store:
        row = stored(data_store)
        job = ReconstructionRow(new_id(), row.id, False, JobState.COMPLETE, NOW, version=3)
        folder = data_store.folder.reconstruction(job.id)
        folder.mkdir(parents=True)
        publisher = Publisher(folder)
        for _ in range(3):
            publisher.publish(Scene.empty(1), trajectory, 0.1)
        data_store.catalogue.reconstructions.put(job)
        for published in publisher.versions[1:]:
            (folder / published.scene).unlink()
    with kept(tmp_path / "data") as data_store:
        until(lambda: data_store.reconstructions.rows.get(job.id).version == 1, "it is told")
        now = data_store.reconstructions.rows.get(job.id)
        assert now.state is JobState.COMPLETE
        assert [one.version for one in data_store.reconstructions.rows.versions(job.id)] == [1]
        assert [one.version for one in versions(folder)] == [1]


def test_a_request_is_not_carried_out_twice_after_a_kill(data_store: DataStore) -> None:
    keys = IdempotencyKeys(data_store.catalogue)
    assert keys.begin("key", "request") is None
    after = IdempotencyKeys(data_store.catalogue)
    with pytest.raises(ConflictError, match="the service ended during the request"):
        after.begin("key", "request")
    assert after.begin("other", "request") is None
    after.finish("other", Answer(201, {}, b"{}"))
    assert IdempotencyKeys(data_store.catalogue).begin("other", "request") == Answer(201, {}, b"{}")


def test_an_upload_whose_capture_cannot_be_saved_keeps_its_files(
    data_store: DataStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    uploads = Uploads(data_store.folder, data_store.catalogue, data_store.disk_space, lambda: MIB)
    row = UploadRow(new_id(), "a.dat", 4, NOW, NOW)
    data_store.catalogue.uploads.put(row)
    part = data_store.folder.upload(row.id)
    files = {part: b"data", part.with_suffix(".json"): b"{}", part.with_suffix(".npz"): b"calibration"}
    for file, content in files.items():
        file.write_bytes(content)

    def move() -> str:
        return uploads._move_to_capture(row, False, Recorded(1, 4), Quality(Grade.GOOD, ()))

    def full(*_: object, **__: object) -> None:
        raise StoreError("the disk is full")

    with monkeypatch.context() as patched:
        patched.setattr(data_store.catalogue.uploads, "set", full)
        with pytest.raises(StoreError):
            move()
    assert {file: file.read_bytes() for file in files} == files
    assert list(data_store.captures.list().items) == []
    data = data_store.folder.recording(move())
    assert data.read_bytes() == b"data" and (data.parent / "calibration.npz").read_bytes() == b"calibration"
    assert not any(file.exists() for file in files)


def test_half_an_upload_is_no_capture_after_a_kill(tmp_path: Path) -> None:
    """Its files have a second name in the folder of a capture without a row."""
    with kept(tmp_path / "data") as data_store:
        row = UploadRow(new_id(), "a.dat", 4, NOW, NOW)
        data_store.catalogue.uploads.put(row)
        part, data = data_store.folder.upload(row.id), data_store.folder.recording(new_id())
        part.write_bytes(b"data")
        data.parent.mkdir()
        data.hardlink_to(part)
    with kept(tmp_path / "data") as data_store:
        until(lambda: not data.parent.exists(), "it is removed")
        assert part.read_bytes() == b"data" and list(data_store.captures.list().items) == []
