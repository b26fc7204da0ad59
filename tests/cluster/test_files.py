"""Files of jobs in an object store."""

import fcntl
import shutil
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import IO

import numpy as np
import pytest
from pydantic import ValidationError
from spiked_service.cluster import object_store
from spiked_service.cluster.attempt_log import AttemptLog
from spiked_service.cluster.configured import cluster_of
from spiked_service.cluster.job_files import INPUTS, OUTPUTS, files_in, moved, stage
from spiked_service.cluster.job_folder import JobFolder
from spiked_service.cluster.messages import StoredFile
from spiked_service.cluster.object_store import ObjectStore, ObjectStoreError, stored_file
from spiked_service.cluster.scratch import scratch_folder
from spiked_service.cluster.shared_recordings import SharedRecordings
from spiked_service.results.versions import Publisher, is_whole, versions
from spiked_service.settings.reconstruction_options import ReconstructionOptions
from spiked_service.settings.settings import load_settings
from spiked_service.workers.messages import ReconstructionCommand

from spiked.errors import ConfigurationError
from spiked.scene import Scene
from spiked.trajectory import Trajectory


class Far(ObjectStore):
    """A store that other machines do not see as a folder."""

    local = False  # type: ignore[assignment]


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(object_store, "_DELAYS_S", (0.0, 0.0))


def command(tmp_path: Path) -> ReconstructionCommand:
    capture, job = tmp_path / "captures" / "c", tmp_path / "reconstructions" / "j"
    for folder in (capture, job / "map-1", job / "checkpoint"):
        folder.mkdir(parents=True)
    for path in (capture / "recording.dat", capture / "recording.json", job / "map-1" / "map.json", job / "log"):
        path.write_text(path.name)
    for name in ("capture.json", "thumbnail.webp", "recording.dat.part"):
        (capture / name).write_text("not for workers")
    (job / "checkpoint" / "state").write_text("state")
    return ReconstructionCommand(
        ring=None,
        recording=capture / "recording.dat",
        folder=job,
        can_block=True,
        options=ReconstructionOptions(),
        intrinsics=None,
        calibration=job / "given-calibration.npz",
        map=job / "map-1",
    )


def test_a_job_takes_along_what_its_worker_reads(tmp_path: Path) -> None:
    given = command(tmp_path)
    store = Far((tmp_path / "store").as_uri())
    recordings = SharedRecordings(Far((tmp_path / "recordings").as_uri()))
    inputs = stage(given, store, lambda folder: recordings.hold(folder, "attempt"))
    assert not inputs.in_place
    assert {one.name for one in inputs.recording} == {"recording.dat", "recording.json"}
    assert {one.name for one in inputs.folder} == {"map-1/map.json", "checkpoint/state"}
    for stored in inputs.recording:
        recordings.store.fetch(stored.sha256, tmp_path / "there" / stored.name, stored)
    for stored in inputs.folder:
        store.fetch(f"{INPUTS}/{stored.sha256}", tmp_path / "there" / stored.name, stored)
    for stored in (*inputs.recording, *inputs.folder):
        assert (tmp_path / "there" / stored.name).read_text() == Path(stored.name).name
    there = moved(given, Path("/job"), Path("/recording"))
    assert isinstance(there, ReconstructionCommand)
    assert (there.folder, there.recording, there.map, there.calibration) == (
        Path("/job"),
        Path("/recording/recording.dat"),
        Path("/job/map-1"),
        Path("/job/given-calibration.npz"),
    )


def test_a_shared_recording_is_read_where_it_is(tmp_path: Path) -> None:
    given = command(tmp_path)
    inputs = stage(given, ObjectStore((tmp_path / "store").as_uri()), lambda folder: pytest.fail("it is not stored"))
    assert inputs.in_place and inputs.recording == []
    there = moved(given, Path("/job"), None)
    assert isinstance(there, ReconstructionCommand)
    assert there.recording == given.recording


def test_a_damaged_or_missing_object_is_an_error_and_leaves_no_file(tmp_path: Path) -> None:
    store = ObjectStore((tmp_path / "store").as_uri())
    source = tmp_path / "source"
    source.write_bytes(b"content")
    stored = stored_file(source, "source")
    store.put_file(source, "a", stored)
    (tmp_path / "store" / "a").write_bytes(b"conten")  # truncated
    with pytest.raises(ObjectStoreError, match="damaged"):
        store.fetch("a", tmp_path / "back", stored)
    with pytest.raises(ObjectStoreError):
        store.fetch("b", tmp_path / "back", stored)
    assert not list(tmp_path.glob("back*"))
    store.put_file(source, "a", stored)  # another size: it was stored in part
    store.fetch("a", tmp_path / "back", stored)
    assert (tmp_path / "back").read_bytes() == b"content"
    assert store.get("b") is None
    store.remove()
    store.remove()
    assert store.get("a") is None


@pytest.mark.parametrize("name", ["../x", "/etc/passwd", "a/../../x", ".hidden", "a/.b", "", "a\\..\\b"])
def test_no_agent_chooses_a_file_outside_of_its_job(name: str) -> None:
    with pytest.raises(ValidationError):
        StoredFile(name=name, bytes=1, sha256="0" * 64)


def test_scratch_of_a_killed_agent_is_removed_and_that_of_others_is_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SPIKED_SCRATCH", str(tmp_path))
    left = tmp_path / "spiked-attempt-left"
    left.mkdir()
    (left / ".lock").touch()
    with scratch_folder() as one:
        assert not left.exists()
        with scratch_folder() as other:
            assert one.is_dir() and other.is_dir() and one != other
        assert one.is_dir() and not other.exists()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        ({"executor": "ray", "executor_store": "nope://bucket"}, "cannot be used as a store"),
        ({"executor": "ray", "host": "0.0.0.0"}, "executor_url"),
    ],
)
def test_settings_that_cannot_work_are_refused(tmp_path: Path, flags: dict[str, object], said: str) -> None:
    with pytest.raises(ConfigurationError, match=said):
        cluster_of(load_settings(flags).settings, tmp_path)
    assert cluster_of(load_settings({}).settings, tmp_path) is None


def test_options_of_the_engine_are_pairs(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="NAME=VALUE"):
        load_settings({"executor_options": "slurm_partition"})


def test_whatever_ends_a_fetch_the_index_lists_only_what_is_there(tmp_path: Path) -> None:
    """Two agents of one attempt made versions with the same names: the service was restarted between them."""
    trajectory = Trajectory(np.array([0.5]), np.eye(3)[None], np.zeros((1, 3)))

    def scene(splats: int) -> Scene:
        shapes = ((splats, 3), (splats, 4), (splats, 3), (splats,), (splats, 1))
        return Scene(*(np.ones(shape, np.float32) for shape in shapes))

    first, second, store = tmp_path / "first", tmp_path / "second", ObjectStore((tmp_path / "store").as_uri())
    for folder, splats in ((first, 1), (second, 2)):
        folder.mkdir()
        publisher = Publisher(folder)
        for _ in range(2):
            publisher.publish(scene(splats), trajectory, 0.1)
    third = Publisher(first).publish(scene(3), trajectory, 0.1)
    files = [stored_file(path, path.name) for path in files_in(second)]
    for missing in (*files, None):
        job = tmp_path / f"job without {missing and missing.name}"
        shutil.copytree(first, job)
        shutil.rmtree(tmp_path / "store", ignore_errors=True)
        for stored in files:
            if stored is not missing:
                store.put_file(second / stored.name, f"{OUTPUTS}/{stored.sha256}", stored)
        one = JobFolder(job, AttemptLog(job / "log", "one"))
        with suppress(ObjectStoreError) if missing else nullcontext():
            one.fetch(files, store)
        assert all(is_whole(job, published) for published in versions(job))
        if missing is None:
            assert versions(job) == versions(second) and not (job / third.scene).exists()


def test_an_agent_whose_scratch_was_removed_before_it_was_locked_makes_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SPIKED_SCRATCH", str(tmp_path))
    made, lock = [], fcntl.flock

    def late(file: IO[str], how: int) -> None:
        if not made:
            made.extend(tmp_path.iterdir())
            shutil.rmtree(made[0])  # as another agent does that finds it not locked
        lock(file, how)

    monkeypatch.setattr("spiked_service.cluster.scratch.fcntl.flock", late)
    with scratch_folder() as folder:
        assert folder.is_dir() and folder != made[0]
    assert not list(tmp_path.iterdir())
