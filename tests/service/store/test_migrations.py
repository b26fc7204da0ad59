"""A catalogue of every former schema opens as one of today, with its rows, and can be put back."""

import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
from spiked_service.base.version import installed_version
from spiked_service.reconstructions.queue_order import QueueOrder
from spiked_service.store.backup import restore
from spiked_service.store.catalogue import Catalogue, StoreError
from spiked_service.store.folder import DataFolder
from spiked_service.store.migrations import MIGRATIONS, schema_of
from spiked_service.store.rows import CaptureState, Grade, JobState

SCHEMAS = sorted((Path(__file__).parent / "schemas").glob("*.sql"))
"""A dump of a catalogue of each former schema, made by the release that wrote it: NUMBER.sql."""
FORMER = pytest.mark.parametrize("dump", SCHEMAS, ids=lambda dump: f"schema {dump.stem}")


def made_of(dump: Path, path: Path) -> Path:
    with closing(sqlite3.connect(path)) as connection:
        connection.executescript(dump.read_text())
    return path


def tables(path: Path) -> set[tuple[str, str]]:
    with closing(sqlite3.connect(path)) as connection:
        rows = connection.execute("SELECT name, sql FROM sqlite_master WHERE sql IS NOT NULL").fetchall()
    return {(name, " ".join(sql.split())) for name, sql in rows}


def check_rows(catalogue: Catalogue) -> None:
    good = next(row for row in catalogue.captures.where() if row.state is CaptureState.COMPLETE)
    assert good.verdict is not None and good.verdict.grade is Grade.DEGRADED
    assert [row.id for row in catalogue.capture_page(group=good.group).items] == [good.id]
    jobs = catalogue.reconstruction_page(capture_id=good.id).items
    assert {row.state for row in jobs} == {JobState.QUEUED, JobState.COMPLETE}
    assert [row.version for job in jobs for row in catalogue.versions(job.id)] == [1]
    assert len(catalogue.capture_page(deleted=True).items) == 1


def test_there_is_a_catalogue_of_every_former_schema() -> None:
    assert [int(dump.stem) for dump in SCHEMAS] == list(range(1, len(MIGRATIONS)))


@FORMER
def test_a_former_catalogue_becomes_one_of_today(dump: Path, tmp_path: Path) -> None:
    Catalogue(tmp_path / "new.sqlite").close()
    catalogue = Catalogue(made_of(dump, tmp_path / "old.sqlite"))
    check_rows(catalogue)
    assert catalogue.damage() is None
    catalogue.close()
    assert tables(tmp_path / "old.sqlite") == tables(tmp_path / "new.sqlite")
    with closing(sqlite3.connect(tmp_path / "old.sqlite")) as connection:
        assert schema_of(connection) == len(MIGRATIONS)
        newest = "SELECT program FROM history ORDER BY schema DESC LIMIT 1"
        assert connection.execute(newest).fetchall() == [(installed_version(),)]
    check_rows(Catalogue(tmp_path / "old.sqlite"))


@FORMER
def test_the_catalogue_before_the_migration_is_kept(dump: Path, tmp_path: Path) -> None:
    folder = DataFolder(tmp_path)
    made_of(dump, folder.catalogue)
    for _ in range(2):
        Catalogue(folder.catalogue, folder).close()
    (copy,) = (tmp_path / "backups").iterdir()
    with closing(sqlite3.connect(copy)) as connection:
        assert schema_of(connection) == int(dump.stem)
        assert connection.execute("SELECT count(*) FROM captures").fetchone() == (2,)
    folder.close()


@FORMER
def test_a_backup_of_a_former_release_is_restored(dump: Path, tmp_path: Path) -> None:
    backup = made_of(dump, tmp_path / "catalogue-of-then.sqlite")
    folder = DataFolder(tmp_path / "data")
    Catalogue(folder.catalogue, folder).close()
    restored, before = restore(folder, backup)
    assert restored == backup and before is not None and before.is_file()
    check_rows(Catalogue(folder.catalogue, folder))
    folder.close()


def test_a_newer_catalogue_names_the_release_that_reads_it(tmp_path: Path) -> None:
    path = tmp_path / "c.sqlite"
    Catalogue(path).close()
    with closing(sqlite3.connect(path, isolation_level=None)) as connection:
        connection.execute("INSERT INTO history VALUES (?, '2030-01-01', '7.1.0')", (len(MIGRATIONS) + 1,))
        connection.execute(f"PRAGMA user_version = {len(MIGRATIONS) + 1}")
    with pytest.raises(StoreError, match=rf"newer spiked \(7\.1\.0\), with schema {len(MIGRATIONS) + 1}"):
        Catalogue(path)


def test_the_order_of_a_former_queue_is_kept(tmp_path: Path) -> None:
    catalogue = Catalogue(made_of(SCHEMAS[1], tmp_path / "old.sqlite"))
    found = catalogue.read("SELECT id, -urgency, held FROM queue ORDER BY urgency, turn, id")
    assert [(row_id[9:13], priority, held) for row_id, priority, held in found] == [
        ("a472", 7, 0), ("a46e", 0, 0), ("a471", 0, 1), ("a470", 0, 0),
    ]  # fmt: skip


def test_what_is_counted_of_a_former_catalogue_is_what_there_is(tmp_path: Path) -> None:
    for dump in SCHEMAS:
        catalogue = Catalogue(made_of(dump, tmp_path / f"{dump.stem}.sqlite"))
        jobs, captures = catalogue.reconstructions.where(), catalogue.captures.where()
        assert sum(catalogue.job_counts().values()) == len(jobs) > 0
        assert catalogue.job_counts(jobs[0].capture_id)[jobs[0].state] > 0
        assert sum(catalogue.capture_counts().values()) == sum(one.deleted_at is None for one in captures) > 0
        assert len(QueueOrder(catalogue)) == sum(one.state is JobState.QUEUED for one in jobs) > 0
        catalogue.close()
