"""Files of jobs in an object store."""

from pathlib import Path

import pytest
from pydantic import ValidationError
from spiked_service.cluster import object_store
from spiked_service.cluster.configured import cluster_of
from spiked_service.cluster.job_files import INPUTS, moved, stage
from spiked_service.cluster.messages import StoredFile
from spiked_service.cluster.object_store import ObjectStore, ObjectStoreError, stored_file
from spiked_service.cluster.scratch import scratch_folder
from spiked_service.cluster.shared_recordings import SharedRecordings
from spiked_service.settings.reconstruction_options import ReconstructionOptions
from spiked_service.settings.settings import load_settings
from spiked_service.workers.messages import ReconstructionCommand

from spiked.errors import ConfigurationError


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
