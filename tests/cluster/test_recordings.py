"""One copy of a recording in the store, and one on each machine, for all jobs that read it."""

import multiprocessing
from pathlib import Path

import numpy as np
import pytest
from spiked_service.base.ids import new_id
from spiked_service.cluster.messages import StoredFile
from spiked_service.cluster.object_store import ObjectStore, ObjectStoreError, stored_file
from spiked_service.cluster.recording_cache import RecordingCache
from spiked_service.cluster.shared_recordings import SharedRecordings
from waiting import meanwhile

from spiked.recording import Durability, RecordingWriter, index_path
from spiked.sensor import Sensor

SENSOR = Sensor(96, 64, 20_000.0)
PLENTY = 1 << 40


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """The folder of a capture: a recording with sidecar and index."""
    folder = tmp_path / "capture"
    folder.mkdir()
    with RecordingWriter(folder / "recording.dat", SENSOR, durability=Durability(index=True)) as writer:
        writer.append(np.random.default_rng(1).integers(0, 256, (200, SENSOR.frame_bytes), np.uint8))
    assert index_path(folder / "recording.dat").exists()
    return folder


@pytest.fixture
def store(bucket: str) -> ObjectStore:
    """A folder of a bucket."""
    return ObjectStore(bucket).below(new_id())


class Machine:
    """The cache of a machine, and what it has fetched."""

    def __init__(self, folder: Path, store: ObjectStore, most_bytes: int = PLENTY) -> None:
        self.folder = folder / "cache"
        self._jobs = folder / "jobs"
        self._store = store
        self.fetched: list[str] = []
        self.cache = RecordingCache(self.folder, most_bytes, self._fetch)

    def _fetch(self, stored: StoredFile, path: Path) -> None:
        self.fetched.append(stored.name)
        self._store.fetch(stored.sha256, path, stored)

    def job(self, files: list[StoredFile]) -> Path:
        """Bring the recording into the folder of a new job, and return that."""
        folder = self._jobs / new_id()
        self.cache.put_into(folder, files)
        return folder

    def kept(self) -> list[Path]:
        """Recordings in the cache."""
        return [path for path in self.folder.iterdir() if path.suffix != ".lock"]


def same(folder: Path, other: Path) -> bool:
    return all((other / path.name).read_bytes() == path.read_bytes() for path in folder.iterdir())


def test_a_recording_is_stored_once_and_fetched_once_for_many_jobs(
    capture: Path, store: ObjectStore, tmp_path: Path
) -> None:
    recordings = SharedRecordings(store)
    first = recordings.hold(capture, "first")
    for stored in first:  # what is there already is not stored again: another content of the same size stays
        store.put(f"{stored.sha256}", b"x" * stored.bytes)
    assert recordings.hold(capture, "second") == first
    assert store.get(first[0].sha256) == b"x" * first[0].bytes
    for stored in first:
        store.put_file(capture / stored.name, f"again-{stored.sha256}", stored)
        store.below(stored.sha256).remove()
    recordings.hold(capture, "third")
    machine = Machine(tmp_path, store)
    folders = [machine.job(first) for _ in range(5)]
    assert sorted(machine.fetched) == ["recording.dat", "recording.index", "recording.json"]
    assert all(same(capture, folder) for folder in folders)
    assert len({(folder / "recording.dat").stat().st_ino for folder in folders}) == 1


def test_a_changed_recording_is_another_one(capture: Path, store: ObjectStore, tmp_path: Path) -> None:
    recordings, machine = SharedRecordings(store), Machine(tmp_path, store)
    machine.job(recordings.hold(capture, "first"))
    (capture / "recording.json").write_text((capture / "recording.json").read_text() + "\n")
    folder = machine.job(recordings.hold(capture, "second"))
    assert same(capture, folder)
    assert machine.fetched.count("recording.json") == 2 and machine.fetched.count("recording.dat") == 1


def test_a_recording_stays_while_an_attempt_reads_it_and_goes_afterwards(capture: Path, store: ObjectStore) -> None:
    recordings = SharedRecordings(store, keep_s=0)
    recordings.hold(capture, "one")
    recordings.hold(capture, "other")
    recordings.hold_all("of an earlier service")
    for attempt in ("one", "other", "of an earlier service"):
        assert recordings.sweep() == 0
        recordings.release(attempt)
    assert recordings.sweep() == 3 and store.objects() == []
    patient = SharedRecordings(store, keep_s=3600)
    patient.hold(capture, "one")
    patient.release("one")
    assert patient.sweep() == 0, "the next job may read it, too"
    assert SharedRecordings(store, keep_s=3600).sweep() == 0, "nor does a service that was just started"


def test_sweeps_and_jobs_that_begin_do_not_disturb_each_other(capture: Path, tmp_path: Path) -> None:
    store = ObjectStore(f"{tmp_path.as_uri()}/store")
    recordings = SharedRecordings(store, keep_s=0)
    with meanwhile(recordings.sweep):
        for number in range(100):
            for stored in recordings.hold(capture, f"{number}"):
                assert store.get(stored.sha256) == (capture / stored.name).read_bytes()
            recordings.release(f"{number}")


@pytest.mark.parametrize("name", ["recording.dat", "recording.json"])
def test_what_is_damaged_on_the_machine_is_fetched_again(
    name: str, capture: Path, store: ObjectStore, tmp_path: Path
) -> None:
    files, machine = SharedRecordings(store).hold(capture, "one"), Machine(tmp_path, store)
    machine.job(files)
    (stored,) = (one for one in files if one.name == name)
    content = bytearray((machine.folder / stored.sha256).read_bytes())
    content[len(content) // 2] ^= 1
    (machine.folder / stored.sha256).chmod(0o600)
    (machine.folder / stored.sha256).write_bytes(content)
    assert same(capture, machine.job(files))
    assert machine.fetched.count(name) == 2 and len(machine.fetched) == 4
    assert same(capture, machine.job(files)) and len(machine.fetched) == 4


def test_a_recording_that_was_damaged_before_it_was_sent_is_as_it_was_sent(
    capture: Path, store: ObjectStore, tmp_path: Path
) -> None:
    content = bytearray((capture / "recording.dat").read_bytes())
    content[1000] ^= 1
    (capture / "recording.dat").write_bytes(content)
    files, machine = SharedRecordings(store).hold(capture, "one"), Machine(tmp_path, store)
    assert all(same(capture, machine.job(files)) for _ in range(2)) and len(machine.fetched) == 3


def test_what_was_used_least_recently_makes_room(store: ObjectStore, tmp_path: Path) -> None:
    machine = Machine(tmp_path, store, most_bytes=250)
    recordings = []
    for number in range(4):
        path = tmp_path / f"{number}" / "recording.dat"
        path.parent.mkdir()
        path.write_bytes(bytes([number]) * 100)
        recordings.append(SharedRecordings(store).hold(path.parent, "one"))
    first = machine.job(recordings[0])
    machine.job(recordings[1])
    machine.job(recordings[0])
    machine.job(recordings[2])
    assert {path.name for path in machine.kept()} == {recordings[0][0].sha256, recordings[2][0].sha256}
    machine.job(recordings[1])
    machine.job(recordings[3])
    assert {path.name for path in machine.kept()} == {recordings[1][0].sha256, recordings[3][0].sha256}
    assert (first / "recording.dat").read_bytes() == bytes(100), "the attempt that reads it keeps it"
    small = Machine(tmp_path / "small", store, most_bytes=50)
    assert (small.job(recordings[3]) / "recording.dat").read_bytes() == bytes([3]) * 100
    assert small.kept() == []


def test_a_failed_fetch_leaves_nothing_and_what_a_killed_agent_left_is_removed(
    capture: Path, store: ObjectStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("spiked_service.cluster.object_store._DELAYS_S", ())
    machine = Machine(tmp_path, store)
    absent = stored_file(capture / "recording.dat", "recording.dat")
    with pytest.raises(ObjectStoreError):
        machine.job([absent])
    assert machine.kept() == []
    (machine.folder / f"{'0' * 64}.part").write_bytes(b"half")
    machine.job(SharedRecordings(store).hold(capture, "one"))
    assert len(machine.kept()) == 3 and not list(machine.folder.glob("*.part"))


def test_the_cache_of_another_user_is_not_used(tmp_path: Path) -> None:
    (tmp_path / "theirs").mkdir()
    (tmp_path / "cache").symlink_to(tmp_path / "theirs")
    with pytest.raises(PermissionError, match="another user"):
        RecordingCache(tmp_path / "cache", PLENTY, lambda stored, path: None)


def _work(cache: Path, store: str, files: list[StoredFile], jobs: Path, said: Path, most_bytes: int) -> None:
    """Several jobs of one agent, in a process of its own."""

    def fetch(stored: StoredFile, path: Path) -> None:
        with said.open("a") as file:
            file.write(f"{stored.name}\n")
        ObjectStore(store).fetch(stored.sha256, path, stored)

    for _ in range(10):
        folder = jobs / new_id()
        RecordingCache(cache, most_bytes, fetch).put_into(folder, files)
        for stored in files:
            assert stored_file(folder / stored.name, stored.name) == stored


@pytest.mark.parametrize("most_bytes", [PLENTY, 160_000])
def test_several_agents_share_a_machine(most_bytes: int, capture: Path, tmp_path: Path) -> None:
    store = ObjectStore(f"{tmp_path.as_uri()}/store")
    files = SharedRecordings(store).hold(capture, "one")
    assert max(stored.bytes for stored in files) < 160_000
    context = multiprocessing.get_context("spawn")
    given = (tmp_path / "cache", store.uri, files, tmp_path / "jobs", tmp_path / "said", most_bytes)
    agents = [context.Process(target=_work, args=given) for _ in range(3)]
    for agent in agents:
        agent.start()
    for agent in agents:
        agent.join()
    assert [agent.exitcode for agent in agents] == [0, 0, 0]
    if most_bytes == PLENTY:
        assert sorted((tmp_path / "said").read_text().split()) == sorted(stored.name for stored in files)
    kept = [path for path in (tmp_path / "cache").iterdir() if path.suffix != ".lock"]
    assert sum(path.stat().st_size for path in kept) <= most_bytes
