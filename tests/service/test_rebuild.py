"""A catalogue that was lost, damaged or replaced by an older one: the data folder keeps its captures."""

import shutil
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from spiked_service.base.ids import new_id
from spiked_service.captures.archive import DataStore
from spiked_service.settings.reconstruction_options import ReconstructionOptions
from spiked_service.store.backup import back_up, restore
from spiked_service.store.catalogue import StoreError
from spiked_service.store.folder import DataFolder
from spiked_service.store.retention import Policy
from spiked_service.store.rows import CaptureState, Grade, JobState, Origin, Plan, UploadRow
from spiked_service.store.snapshot import Snapshot
from waiting import until

from spiked.recording import index_path, open_recording, sidecar_path

from .survival import assert_holds, jobs_of, kept, over, random_recording, received

FRAMES = 512


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data folder with a capture that was named, is kept and has a reconstruction, after a clean end."""
    data = tmp_path_factory.mktemp("original") / "data"
    with kept(data) as data_store:
        source = "sim:?width=160&height=100&pace=0"
        plan = Plan(source, frames=FRAMES, name="desk", options=ReconstructionOptions(steps=5))
        capture_id = data_store.captures.start(plan).id
        over(data_store, capture_id)
        data_store.captures.update(capture_id, notes="by hand", keep=True)
    return data


@pytest.fixture
def data(original: Path, tmp_path: Path) -> Path:
    """A copy of it that may be broken."""
    shutil.copytree(original, tmp_path / "data")
    return tmp_path / "data"


def only_id(folder: Path) -> str:
    """The name of the only folder in there."""
    (found,) = [entry.name for entry in folder.iterdir()]
    return found


@pytest.fixture
def recording(data: Path) -> Path:
    """The recording in it."""
    return data / "captures" / only_id(data / "captures") / "recording.dat"


def only(data_store: DataStore) -> Snapshot:
    """The only capture, once everything that was left over has been looked at."""
    until(lambda: data_store.check_catalogue()[1] == "", "what was left over has been looked at")
    (row,) = data_store.captures.list().items
    return data_store.captures.get(row.id)


def assert_as_before(snapshot: Snapshot, data_store: DataStore, origin: Origin = Origin.RECOVERED) -> None:
    """All that was known of the capture is known again, and its files are there."""
    row = snapshot.row
    assert (row.origin, row.name, row.notes, row.keep) == (origin, "desk", "by hand", True)
    assert row.state is CaptureState.COMPLETE
    assert row.recording is not None and (row.recording.frames, row.recording.lost) == (FRAMES, 0)
    assert row.verdict is not None and row.verdict.grade is Grade.GOOD
    assert open_recording(data_store.captures.recording(row.id)).frames == FRAMES
    (job,) = jobs_of(data_store, snapshot.id)
    assert (job.state, job.capture_id, job.options.steps) == (JobState.COMPLETE, row.id, 5)
    versions = data_store.reconstructions.rows.versions(job.id)
    assert versions and versions[-1].version == job.version
    assert (data_store.reconstructions.rows.folder(job.id) / f"scene-{job.version:06d}.ply").exists()


def removed(catalogue: Path) -> None:
    catalogue.unlink()


def emptied(catalogue: Path) -> None:
    catalogue.write_bytes(b"")


def garbage(catalogue: Path) -> None:
    catalogue.write_bytes(b"this is no database\n" * 1000)


def truncated(catalogue: Path) -> None:
    catalogue.write_bytes(catalogue.read_bytes()[: catalogue.stat().st_size // 2])


def with_a_wrong_page(catalogue: Path) -> None:
    content = bytearray(catalogue.read_bytes())
    content[4096 : 2 * 4096] = bytes(4096)
    catalogue.write_bytes(content)


def with_an_unreadable_row(catalogue: Path) -> None:
    content = catalogue.read_bytes()
    assert b'"origin":"live"' in content
    catalogue.write_bytes(content.replace(b'"origin":"live"', b'"origin":"lxve"'))


DAMAGES = [removed, emptied, garbage, truncated, with_a_wrong_page, with_an_unreadable_row]
UNNOTICED = (removed, emptied)
"""There is nothing to be put aside: a folder without a catalogue is a new one."""


@pytest.mark.parametrize("damage", DAMAGES, ids=lambda damage: damage.__name__)
def test_captures_and_results_outlive_their_catalogue(data: Path, damage: Callable[[Path], None]) -> None:
    damage(data / "catalogue.sqlite")
    broken = b"" if damage in UNNOTICED else (data / "catalogue.sqlite").read_bytes()
    with kept(data) as data_store:
        assert_as_before(only(data_store), data_store)
    aside = list(data.glob("catalogue.sqlite.damaged-*"))
    assert [path.read_bytes() for path in aside if not path.name.endswith(("-wal", "-shm"))] == [broken][: bool(broken)]
    with kept(data) as data_store:
        assert_as_before(only(data_store), data_store)
    assert not (data / "lost+found").exists()


def test_an_older_catalogue_brings_no_older_state(data: Path, tmp_path: Path) -> None:
    older = tmp_path / "older.sqlite"
    shutil.copy(data / "catalogue.sqlite", older)
    random_recording(tmp_path / "noise.dat", 100)
    with kept(data) as data_store:
        (first,) = data_store.captures.list().items
        data_store.captures.update(first.id, name="desk, renamed", keep=False)
        second = data_store.captures.start(Plan(f"replay:{tmp_path / 'noise.dat'}", reconstruct=False, name="later")).id
        over(data_store, second)
        data_store.captures.update(second, keep=True)
        # As a killed service leaves it, with a log that belongs to the newer file.
        for suffix in ("-wal", "-shm"):
            shutil.copy(data / f"catalogue.sqlite{suffix}", tmp_path / f"newer{suffix}")
    shutil.copy(older, data / "catalogue.sqlite")
    for suffix in ("-wal", "-shm"):
        shutil.copy(tmp_path / f"newer{suffix}", data / f"catalogue.sqlite{suffix}")
    with kept(data) as data_store:
        until(lambda: data_store.check_catalogue()[1] == "", "what was left over has been looked at")
        rows = {row.id: row for row in data_store.captures.list().items}
        assert {one: (row.name, row.keep) for one, row in rows.items()} == {
            first.id: ("desk, renamed", False),
            second: ("later", True),
        }
        data_store.retention.policy = Policy(bytes=1)
        data_store.retention.apply()
        assert [row.id for row in data_store.captures.list().items] == [second]
        assert open_recording(data_store.captures.recording(second)).frames == 100


def without_rows(data: Path) -> None:
    """As an earlier version left it, which knew no copies of rows."""
    (data / "catalogue.sqlite").unlink()
    for copy in (*data.rglob("capture.json"), *data.rglob("reconstruction.json")):
        copy.unlink()


def test_without_any_row_sidecar_and_index_tell_what_there_is(data: Path, recording: Path) -> None:
    without_rows(data)
    with kept(data) as data_store:
        row = only(data_store).row
        assert (row.origin, row.name, row.keep) == (Origin.RECOVERED, "desk", True)
        assert (row.state, row.plan.source) == (CaptureState.COMPLETE, "sim:?width=160&height=100&pace=0")
        assert row.recording is not None and (row.recording.frames, row.recording.lost) == (FRAMES, 0)
        assert row.recording.bytes == recording.stat().st_size
        assert row.verdict is not None and (row.verdict.grade, row.verdict.reasons) == (Grade.GOOD, ())
        assert row.sensor is not None and (row.sensor.width, row.sensor.height) == (160, 100)
        assert abs((row.started_at - row.ended_at).total_seconds()) < 3600 if row.ended_at else False
        assert "marked to be kept" in row.warnings[0]
        data_store.retention.policy = Policy(bytes=1, days=1e-9)
        data_store.retention.apply()
        assert recording.exists()
        job = data_store.reconstructions.submit(row.id, ReconstructionOptions(steps=1))
        until(lambda: data_store.reconstructions.rows.get(job.id).state is JobState.COMPLETE, "it is reconstructed")
    (lost,) = (data / "lost+found").iterdir()
    assert (lost / "published.json").exists(), "nothing says which capture it is of, but it is not removed"


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data folder as a kill of everything leaves it: `data`, with a capture of the frames of `noise.dat`."""
    folder = tmp_path_factory.mktemp("killed")
    random_recording(folder / "noise.dat", 997)
    with kept(folder / "alive") as data_store:
        source = f"replay:{folder / 'noise.dat'}?repeat=9999"
        capture_id = data_store.captures.start(Plan(source, reconstruct=False, name="noise", notes="n")).id
        until(lambda: received(data_store, capture_id) > 5000, "frames come")
        shutil.copytree(folder / "alive", folder / "data")
        data_store.captures.stop(capture_id)
        over(data_store, capture_id)
    return folder


@pytest.mark.parametrize("with_row", [True, False])
@pytest.mark.parametrize("index", ["whole", "missing", "garbage", "cut"])
def test_an_unfinished_recording_is_found_without_a_catalogue(
    killed: Path, tmp_path: Path, with_row: bool, index: str
) -> None:
    frames = open_recording(killed / "noise.dat").data
    data = shutil.copytree(killed / "data", tmp_path / "data")
    capture_id = only_id(data / "captures")
    (data / "catalogue.sqlite").unlink()
    path = data / "captures" / capture_id / "recording.dat"
    if not with_row:
        (path.parent / "capture.json").unlink()
    if index == "missing":
        index_path(path).unlink()
    elif index == "garbage":
        index_path(path).write_bytes(b"no index" * 100)
    elif index == "cut":
        index_path(path).write_bytes(index_path(path).read_bytes()[:-7])
    with kept(data) as data_store:
        row = only(data_store).row
        assert (row.origin, row.state) == (Origin.RECOVERED, CaptureState.FAILED)
        assert row.reason == "the service ended during the capture"
        assert (row.name, row.notes, row.keep) == ("noise", "n" if with_row else "", not with_row)
        assert row.recording is not None and row.recording.frames > 4000
        assert row.verdict is not None and row.verdict.grade is Grade.DEGRADED
        assert open_recording(path).frames == row.recording.frames
        assert open_recording(path).warnings == ()
        assert_holds(path, frames)


def test_a_sidecar_that_was_lost_is_rebuilt_from_the_row(data: Path, recording: Path) -> None:
    before = open_recording(recording)
    sidecar_path(recording).unlink()
    with kept(data) as data_store:
        until(lambda: sidecar_path(recording).exists(), "it is there again")
        row = only(data_store).row
        assert row.verdict is not None and row.verdict.grade is Grade.DEGRADED
        assert "its sidecar was missing and was rebuilt" in row.verdict.reasons
        after = open_recording(recording)
        assert (after.sensor, after.frames, after.clock) == (before.sensor, before.frames, before.clock)


def test_what_cannot_be_read_goes_to_lost_and_found(data: Path, recording: Path, capfd: Any) -> None:
    without_rows(data)
    capture_id = recording.parent.name
    sidecar_path(recording).unlink()
    content = recording.read_bytes()
    half = data / "captures" / f"{capture_id[:-1]}{'0' if capture_id[-1] != '0' else '1'}"
    half.mkdir()
    (half / "thumbnail.webp").write_bytes(b"RIFF")
    a_file = data / "captures" / f"{capture_id[:-2]}{'0' if capture_id[-2] != '0' else '1'}{capture_id[-1]}"
    a_file.write_bytes(b"not a folder")
    with kept(data) as data_store:
        until(lambda: data_store.check_catalogue()[1] == "", "what was left over has been looked at")
        assert data_store.captures.list().items == []
    lost = data / "lost+found"
    assert (lost / capture_id / "recording.dat").read_bytes() == content
    assert (lost / half.name / "thumbnail.webp").read_bytes() == b"RIFF"
    assert (lost / a_file.name).read_bytes() == b"not a folder"
    told = capfd.readouterr().out
    for name in (capture_id, half.name, a_file.name):
        assert f"capture {name} has no catalogue row and cannot be read: it was moved to {lost}" in told


def test_a_recording_that_is_gone_is_told(data: Path, recording: Path) -> None:
    recording.unlink()
    with kept(data) as data_store:
        row = only(data_store).row
        assert row.recording is None and (row.name, row.keep) == ("desk", True)
        assert row.verdict is not None and row.verdict.grade is Grade.BAD
        assert row.verdict.reasons == (f"the recording {recording} is missing",)


def test_a_folder_that_may_not_be_read_keeps_nobody_from_the_others(data: Path, tmp_path: Path) -> None:
    """As another user, because nothing keeps root from reading."""
    capture_id = only_id(data / "captures")
    sealed = f"{capture_id[:-1]}{'0' if capture_id[-1] != '0' else '1'}"
    (data / "captures" / sealed).mkdir()
    (data / "captures" / sealed / "recording.dat").write_bytes(b"secret")
    script = (
        "import os, sys, time\n"
        "from pathlib import Path\n"
        "from spiked_service.api.bus_notifier import BusNotifier\n"
        "from spiked_service.events.bus import Bus\n"
        "from spiked_service.daemon import open_data_store\n"
        "os.setuid(65534)\n"
        "data_store = open_data_store(Path(sys.argv[1]), BusNotifier(Bus()))\n"
        "while data_store.check_catalogue()[1]: time.sleep(0.02)\n"
        "print([row.name for row in data_store.captures.list().items])\n"
        "data_store.close()\n"
    )
    if subprocess.run(["chown", "-R", "65534", str(data)], capture_output=True, check=False).returncode:
        pytest.skip("only root can give files to another user")
    for parent in (data, *data.parents):
        if parent == Path("/"):
            break
        parent.chmod(0o755)
    shutil.chown(data / "captures" / sealed, 0)
    (data / "captures" / sealed).chmod(0o700)
    (data / "catalogue.sqlite").unlink()
    done = subprocess.run([sys.executable, "-c", script, str(data)], capture_output=True, text=True, check=False)
    assert done.stdout.splitlines()[-1] == "['desk']", done.stdout + done.stderr
    assert (data / "captures" / sealed / "recording.dat").read_bytes() == b"secret"
    assert f"{sealed} could not be checked" in done.stdout or f"{sealed} cannot be checked" in done.stdout, done.stdout


def spiked(*arguments: str) -> subprocess.CompletedProcess[str]:
    """The command line."""
    return subprocess.run(
        [sys.executable, "-m", "spiked_service", *arguments], capture_output=True, text=True, check=False
    )


def test_a_backup_made_while_the_daemon_captures_is_restored(daemon: Any, tmp_path: Path) -> None:
    """The copy is consistent; what came after it is taken from the files."""
    data = tmp_path / "data"
    one = daemon()
    capture = {"source": "sim:?width=96&height=64", "reconstruct": False}
    first = one.http.post("captures", json={**capture, "frames": 100, "name": "first"}).json()["id"]
    until(lambda: one.http.get(f"captures/{first}").json()["state"] == "complete", "the first is over")
    running = one.http.post("captures", json={**capture, "name": "running"}).json()["id"]
    made = spiked("backup", "--data", str(data))
    assert made.returncode == 0, made.stderr
    (copy,) = (data / "backups").iterdir()
    assert made.stdout.strip() == str(copy)
    refused = spiked("restore", "--data", str(data))
    assert refused.returncode == 2 and "another service uses the data folder" in refused.stderr
    one.http.patch(f"captures/{first}", json={"name": "first, renamed", "keep": True})
    one.http.post(f"captures/{running}:stop")
    until(lambda: one.http.get(f"captures/{running}").json()["state"] == "complete", "the second is over")
    one.close()
    (data / "catalogue.sqlite").write_bytes(b"broken")
    done = spiked("restore", "--data", str(data))
    assert done.returncode == 0, done.stderr
    (before,) = data.glob("catalogue.sqlite.before-restore-*")
    assert before.read_bytes() == b"broken" and str(before) in done.stdout
    another = daemon()
    told = {row["id"]: row for row in another.http.get("captures").json()["items"]}
    assert (told[first]["name"], told[first]["keep"]) == ("first, renamed", True)
    assert (told[running]["state"], told[running]["name"], told[running]["origin"]) == ("complete", "running", "live")
    assert another.http.get(f"captures/{running}/recording").status_code == 200


def test_only_a_whole_catalogue_is_restored(data: Path, tmp_path: Path) -> None:
    catalogue = data / "catalogue.sqlite"
    before = catalogue.read_bytes()
    (tmp_path / "half.sqlite").write_bytes(before[: len(before) // 2])
    (tmp_path / "garbage.sqlite").write_bytes(b"garbage" * 1000)
    (tmp_path / "empty.sqlite").touch()
    (tmp_path / "folder.sqlite").mkdir()
    with closing(sqlite3.connect(tmp_path / "foreign.sqlite")) as other:
        other.execute("CREATE TABLE pages (address)")
    folder = DataFolder(data)
    for file in ("half.sqlite", "garbage.sqlite", "missing.sqlite", "empty.sqlite", "folder.sqlite", "foreign.sqlite"):
        with pytest.raises(StoreError, match=file):
            restore(folder, tmp_path / file)
    with pytest.raises(StoreError, match="there is no backup"):
        restore(folder)
    assert catalogue.read_bytes() == before
    assert back_up(catalogue, tmp_path / "elsewhere.sqlite") == tmp_path / "elsewhere.sqlite"
    with pytest.raises(StoreError, match="exists already"):
        back_up(catalogue, tmp_path / "elsewhere.sqlite")
    assert [path.name for path in tmp_path.glob("elsewhere*")] == ["elsewhere.sqlite"]
    restore(folder, tmp_path / "elsewhere.sqlite")
    folder.close()
    with kept(data) as data_store:
        assert_as_before(only(data_store), data_store, Origin.LIVE)
    assert spiked("backup", "--data", str(tmp_path / "nowhere")).stderr.startswith("error: there is no catalogue in")


def test_an_upload_outlives_the_catalogue_too(tmp_path: Path) -> None:
    data = tmp_path / "data"
    now = datetime.now(UTC)
    with kept(data) as data_store:
        row = UploadRow(new_id(), "a.dat", 10, now, now, offset_bytes=3)
        data_store.folder.upload(row.id).write_bytes(b"abc")
        data_store.catalogue.uploads.put(row)
        nameless = data_store.folder.upload(new_id())
        nameless.write_bytes(b"whose?")
    (data / "catalogue.sqlite").unlink()
    with kept(data) as data_store:
        until(lambda: data_store.check_catalogue()[1] == "", "what was left over has been looked at")
        data_store.retention.apply()
        assert data_store.catalogue.uploads.where() == [row]
        assert data_store.folder.upload(row.id).read_bytes() == b"abc"
    assert (data / "lost+found" / nameless.name).read_bytes() == b"whose?"
