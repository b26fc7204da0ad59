"""A purged capture is gone at once and for good: while it is being deleted, after kills, with old backups."""

import shutil
import signal
import sqlite3
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pytest
from spiked_service.base.errors import BusyError
from spiked_service.base.ids import new_id
from spiked_service.captures.archive import DataStore
from spiked_service.store.backup import restore
from spiked_service.store.catalogue import Catalogue, StoreError, UnknownIdError
from spiked_service.store.folder import DataFolder
from spiked_service.store.purges import Purges
from spiked_service.store.rows import (
    CaptureRow,
    CaptureState,
    JobState,
    MapRef,
    Origin,
    Plan,
    ReconstructionRow,
    Task,
    VersionRow,
)
from waiting import until

from .survival import kept

NOW = datetime(2026, 11, 27, 12, 0, 0, 0, UTC)
STATES = (JobState.QUEUED, JobState.COMPLETE, JobState.FAILED)


def filled(catalogue: Catalogue, folder: DataFolder, jobs: int, files: bool = True) -> str:
    """A removed capture with a recording and jobs; two in three have files, one in three waits and is held."""
    row = CaptureRow(new_id(), Origin.LIVE, Plan("sim:"), CaptureState.COMPLETE, NOW, ended_at=NOW, deleted_at=NOW)
    folder.capture(row.id).mkdir()
    folder.recording(row.id).write_bytes(bytes(1 << 20))
    with catalogue.transaction():
        catalogue.captures.put(row)
        for number in range(jobs):
            state, merges = STATES[number % 3], number % 7 == 0
            job = ReconstructionRow(new_id(), row.id, False, state, NOW, held=True)
            if merges:
                job = replace(job, task=Task.MERGE, maps=(MapRef(new_id()), MapRef(new_id())))
            if files and state is not JobState.QUEUED:
                folder.reconstruction(job.id).mkdir()
                (folder.reconstruction(job.id) / "scene-000001.ply").write_bytes(b"scene")
            catalogue.reconstructions.put(job)
            if state is JobState.COMPLETE:
                catalogue.put_version(VersionRow(job.id, 1, NOW, 1, 1, 1.0, 5), {1})
    return row.id


@pytest.fixture
def data(tmp_path: Path) -> Path:
    return tmp_path / "data"


@pytest.fixture
def data_store(data: Path) -> Iterator[DataStore]:
    with kept(data) as one:
        yield one


def rows_left(data: Path, capture_id: str) -> dict[str, int]:
    """Rows of a purged capture, by table, whatever the service shows."""
    jobs = f"SELECT id FROM jobs WHERE capture_id = '{capture_id}'"
    queries = {
        "captures": f"captures WHERE id = '{capture_id}'",
        "capture_list": f"capture_list WHERE id = '{capture_id}'",
        "jobs": f"jobs WHERE capture_id = '{capture_id}'",
        "job_counts": f"job_counts WHERE capture_id = '{capture_id}'",
        "reconstructions": f"reconstructions WHERE capture_id = '{capture_id}'",
        "versions": f"versions WHERE reconstruction_id IN ({jobs})",
        "queue": f"queue WHERE recording = '{capture_id}'",
        "purges": "purges",
    }
    with closing(sqlite3.connect(data / "catalogue.sqlite")) as connection:
        found = {
            table: connection.execute(f"SELECT count(*) FROM {rest}").fetchone()[0] for table, rest in queries.items()
        }
    return {table: count for table, count in found.items() if count}


def files_left(data: Path, known: int) -> list[str]:
    """Names below `captures` and `reconstructions` beyond the `known` number of jobs and one capture."""
    found = [path.name for name in ("captures", "reconstructions") for path in (data / name).iterdir()]
    return found if len(found) > known + 1 else []


def all_gone(data: Path, capture_id: str) -> bool:
    return not rows_left(data, capture_id) and not (data / "captures" / f".{capture_id}.removed").exists()


def test_what_was_purged_is_gone_for_whoever_reads_while_it_is_deleted(data_store: DataStore) -> None:
    catalogue, rows = data_store.catalogue, data_store.reconstructions.rows
    doomed = filled(catalogue, data_store.folder, 300)
    other = filled(catalogue, data_store.folder, 30)
    ids = [row.id for row in catalogue.reconstruction_page(400, capture_id=doomed).items]
    others = {row.id for row in catalogue.reconstruction_page(400, capture_id=other).items}
    until(lambda: data_store.check_catalogue()[1] == "", "the start is over")
    with rows._lock:  # no row of a job is deleted meanwhile
        data_store.captures.removal.purge(doomed)
        for look in (
            lambda: data_store.captures.get(doomed),
            lambda: data_store.captures.removal.restore(doomed),
            lambda: data_store.captures.removal.purge(doomed),
            lambda: data_store.captures.update(doomed, name="back"),
            lambda: data_store.reconstructions.submit(doomed),
            *(lambda one=one: rows.get(one) for one in ids[:3]),
            *(lambda one=one: rows.versions(one) for one in ids[:3]),
            *(lambda one=one: data_store.reconstructions.restart(one) for one in ids[:3]),
        ):
            with pytest.raises(UnknownIdError):
                look()
        assert [row.id for row in data_store.captures.list(deleted=True).items] == [other]
        assert rows.page(capture_id=doomed).items == [] and rows.jobs_of(doomed).total == 0
        assert {row.id for row in rows.page(400).items} == others
        queue = rows.in_turn(100)
        assert {row.id for row in queue.items} <= others and queue.total == len(queue.items) == 10
        assert {row.id for row in rows.queued()} == set(), "all are held"
        assert sum(rows.counts().values()) == 30 and rows.shown_of([doomed]) == []
        assert not {*catalogue.ended_reconstructions(), *catalogue.lost_reconstructions()} - others
        assert len(Purges(catalogue).some_jobs(doomed, 400)) == 100, "those that wait, first: they are still there"
    until(lambda: all_gone(data_store.folder.path, doomed), "all of it is deleted")
    assert sum(rows.counts().values()) == 30 and files_left(data_store.folder.path, 20) == []
    assert catalogue.damage() is None


def steps_of_a_purge(data: Path, jobs: int, monkeypatch: pytest.MonkeyPatch) -> tuple[int, list[int]]:
    """Tens of steps of SQLite's machine of the request, and jobs of each transaction in the background."""
    at_once: list[int] = []
    remove_jobs = Catalogue.remove_jobs

    def counted(self: Catalogue, ids: list[str]) -> None:
        at_once.append(len(ids))
        remove_jobs(self, ids)

    monkeypatch.setattr(Catalogue, "remove_jobs", counted)
    with kept(data) as one:
        capture_id = filled(one.catalogue, one.folder, jobs, files=False)
        until(lambda: one.check_catalogue()[1] == "", "the start is over")
        steps = 0

        def step() -> int:
            nonlocal steps
            steps += 1
            return 0

        with one.reconstructions.rows._lock:
            one.catalogue._writer.set_progress_handler(step, 10)
            one.captures.removal.purge(capture_id)
            one.catalogue._writer.set_progress_handler(None, 0)
        until(lambda: all_gone(data, capture_id), "all of it is deleted")
    return steps, at_once


def test_the_work_of_a_purge_in_its_request_does_not_grow_with_the_jobs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    few, _ = steps_of_a_purge(tmp_path / "few", 60, monkeypatch)
    many, at_once = steps_of_a_purge(tmp_path / "many", 1500, monkeypatch)
    assert many <= 2 * few + 20
    assert sum(at_once) == 1500 and max(at_once) <= 32


def test_of_two_purges_at_once_one_is_told_that_it_is_gone(data_store: DataStore) -> None:
    ids = [filled(data_store.catalogue, data_store.folder, 20) for _ in range(10)]
    together = threading.Barrier(2)

    def purge(capture_id: str) -> bool:
        together.wait()
        try:
            data_store.captures.removal.purge(capture_id)
        except UnknownIdError:
            return False
        return True

    with ThreadPoolExecutor(2) as clients:
        for capture_id in ids:
            assert sorted(clients.map(purge, [capture_id] * 2)) == [False, True]
    until(lambda: all(all_gone(data_store.folder.path, one) for one in ids), "all of them are deleted")


def test_a_purge_that_cannot_be_noted_changes_nothing(data_store: DataStore, monkeypatch: pytest.MonkeyPatch) -> None:
    capture_id = filled(data_store.catalogue, data_store.folder, 3)

    def full(self: Purges, capture_id: str) -> None:
        raise StoreError("the disk is full")

    with monkeypatch.context() as context, pytest.raises(StoreError):
        context.setattr(Purges, "begin", full)
        data_store.captures.removal.purge(capture_id)
    assert data_store.folder.recording(capture_id).exists() and data_store.folder.purged() == set()
    assert data_store.captures.removal.restore(capture_id).jobs.total == 3


def test_what_is_edited_or_runs_is_not_purged(data_store: DataStore) -> None:
    capture_id = filled(data_store.catalogue, data_store.folder, 3)
    rows = data_store.reconstructions.rows
    job = rows.page(capture_id=capture_id, state=JobState.COMPLETE).items[0]
    rows._edited.add(job.id)
    with pytest.raises(BusyError, match="being written"):
        data_store.captures.removal.purge(capture_id)
    rows._edited.clear()
    data_store.catalogue.reconstructions.set(job.id, state=JobState.RUNNING)
    with pytest.raises(BusyError, match="cancel it first"):
        data_store.captures.removal.purge(capture_id)
    data_store.catalogue.reconstructions.set(job.id, state=JobState.FAILED)
    data_store.captures.removal.purge(capture_id)


PURGE = """
import sys, time
from pathlib import Path
from spiked_service.api.bus_notifier import BusNotifier
from spiked_service.daemon import open_data_store
from spiked_service.events.bus import Bus
one = open_data_store(Path(sys.argv[1]), BusNotifier(Bus()))
print("begin", flush=True)
one.captures.removal.purge(sys.argv[2])
print("purged", flush=True)
time.sleep(60)
"""


def killed_while_purging(data: Path, capture_id: str, moment: str, left: Callable[[], bool] = lambda: True) -> None:
    """Purge in a process of its own, which is killed when it has said `moment` and `left` is true."""
    command = [sys.executable, "-c", PURGE, f"{data}", capture_id]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None
        while other.stdout.readline().strip() != moment:
            assert other.poll() is None, "it has failed"
        until(left, "the moment has come")
        other.send_signal(signal.SIGKILL)


@pytest.fixture
def doomed(data: Path) -> str:
    folder = DataFolder(data)
    catalogue = Catalogue(folder.catalogue, folder)
    capture_id = filled(catalogue, folder, 600)
    filled(catalogue, folder, 6)
    catalogue.close()
    folder.close()
    return capture_id


def jobs_left(data: Path) -> int:
    return len(list((data / "reconstructions").iterdir()))


@pytest.mark.parametrize("jobs", [350])
def test_a_purge_that_was_killed_goes_on_and_shows_nothing_of_it(data: Path, doomed: str, jobs: int) -> None:
    killed_while_purging(data, doomed, "purged", lambda: jobs_left(data) < jobs)
    assert rows_left(data, doomed)["purges"] == 1 and (data / "captures" / f".{doomed}.removed").is_dir()
    with kept(data) as again:
        with pytest.raises(UnknownIdError):
            again.captures.get(doomed)
        assert again.reconstructions.rows.page(capture_id=doomed).items == []
        assert sum(again.reconstructions.rows.counts().values()) == 6
        until(lambda: all_gone(data, doomed), "it is deleted by the next service")
    assert files_left(data, 4) == [] and not (data / "lost+found").exists()


def test_a_purge_that_was_killed_at_its_beginning_is_done_or_never_was(data: Path, doomed: str) -> None:
    killed_while_purging(data, doomed, "begin")
    with kept(data) as again:
        if (data / "captures" / doomed).exists():
            assert again.captures.get(doomed).jobs.total == 600
            again.captures.removal.purge(doomed)
        until(lambda: all_gone(data, doomed), "it is deleted")
    assert files_left(data, 4) == []


@pytest.mark.parametrize("catalogue", ["lost", "of a backup"])
def test_nothing_comes_back_when_the_catalogue_is_replaced_meanwhile(data: Path, doomed: str, catalogue: str) -> None:
    backup = shutil.copy(data / "catalogue.sqlite", data.parent / "backup.sqlite")
    killed_while_purging(data, doomed, "purged", lambda: jobs_left(data) < 350)
    folder = DataFolder(data)
    if catalogue == "lost":
        folder.set_catalogue_aside("lost")
    else:
        restore(folder, Path(backup))
    folder.close()
    with kept(data) as again:
        with pytest.raises(UnknownIdError):
            again.captures.get(doomed)
        assert again.reconstructions.rows.page(capture_id=doomed).items == []
        until(lambda: all_gone(data, doomed), "it is deleted all the same")
    assert not (data / "lost+found").exists()


@pytest.mark.parametrize("with_catalogue", [True, False])
def test_a_capture_whose_files_are_put_back_is_there_again(data: Path, doomed: str, with_catalogue: bool) -> None:
    """As `rsync` and `spiked restore` do, while the purge has not ended."""
    with kept(data):
        pass  # writes the copies beside the files
    shutil.copytree(data, data.parent / "backup")
    killed_while_purging(data, doomed, "purged", lambda: jobs_left(data) < 350)
    ignored = shutil.ignore_patterns("catalogue.sqlite*", "lock")
    shutil.copytree(data.parent / "backup", data, ignore=ignored, dirs_exist_ok=True)
    if with_catalogue:
        folder = DataFolder(data)
        restore(folder, data.parent / "backup" / "catalogue.sqlite")
        folder.close()
    with kept(data) as again:
        until(lambda: again.check_catalogue()[1] == "", "the start is over")
        assert (data / "captures" / doomed / "recording.dat").exists()
        assert again.captures.get(doomed).row.id == doomed
        assert again.reconstructions.rows.jobs_of(doomed).total == (600 if with_catalogue else 400), (
            "all that have files"
        )
        assert Purges(again.catalogue).ids() == [] and again.folder.purged() == set()
