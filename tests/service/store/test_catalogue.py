"""The catalogue keeps rows whatever happens around it."""

import gc
import sqlite3
import threading
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import psutil
import pytest
from pydantic import TypeAdapter
from spiked_service.base.ids import is_id, new_id
from spiked_service.settings.reconstruction_options import ReconstructionOptions
from spiked_service.store.catalogue import Catalogue, StoreError, UnknownIdError
from spiked_service.store.rows import (
    CaptureRow,
    CaptureState,
    ConsumerCounters,
    Grade,
    JobState,
    Origin,
    Plan,
    Quality,
    ReconstructionRow,
    Recorded,
    VersionRow,
)

from spiked.sensor import Intrinsics, Mosaic, Sensor

NOW = datetime(2026, 11, 21, 7, 10, 0, 123456, UTC)


def capture(name: str = "", **more: object) -> CaptureRow:
    return replace(
        CaptureRow(new_id(), Origin.LIVE, Plan("sim:?seed=1"), CaptureState.STREAMING, NOW, name=name), **more
    )  # type: ignore[arg-type]


def job(capture_id: str, **more: object) -> ReconstructionRow:
    return replace(ReconstructionRow(new_id(), capture_id, False, JobState.QUEUED, NOW), **more)  # type: ignore[arg-type]


@pytest.fixture
def catalogue(tmp_path: Path) -> Catalogue:
    return Catalogue(tmp_path / "catalogue.sqlite")


def test_ids_sort_as_they_were_made_also_within_a_millisecond() -> None:
    ids = [new_id() for _ in range(2000)]
    assert ids == sorted(set(ids))
    assert all(is_id(one) for one in ids)
    assert not any(is_id(text) for text in ("", "..", ids[0].upper() + "/", f"{ids[0]}\n", "../" + ids[0]))


def test_counters_of_the_last_release_are_read() -> None:
    stored = {"name": "recorder", "policy": "priority", "received": 7, "lost": 1}
    counters = TypeAdapter(ConsumerCounters).validate_python(stored | {"lag_frames": 0, "fill": 0.0, "lagging": False})
    assert (counters.frames_read, counters.lost) == (7, 1)


def test_a_row_comes_back_as_it_was_put_after_closing_too(tmp_path: Path) -> None:
    row = capture(
        "Wohnzimmer",
        sensor=Sensor(400, 250, 20_000.0, mosaic=Mosaic.BGGR, intrinsics=Intrinsics(1, 2, 3, 4)),
        verdict=Quality(Grade.DEGRADED, ("5 frames were lost",)),
        recording=Recorded(100, 1_250_000),
        warnings=("one", "two"),
        ended_at=NOW,
        plan=Plan("sim:", frames=3, options=ReconstructionOptions(steps=7), intrinsics=Intrinsics(1, 2, 3, 4)),
    )
    first = Catalogue(tmp_path / "c.sqlite")
    first.captures.put(row)
    first.close()
    second = Catalogue(tmp_path / "c.sqlite")
    assert second.captures.get(row.id) == row
    assert sqlite3.connect(tmp_path / "c.sqlite").execute("PRAGMA journal_mode").fetchone() == ("wal",)


def test_pages_are_newest_first_and_complete(catalogue: Catalogue) -> None:
    rows = [capture(f"room {number}") for number in range(7)]
    for row in rows:
        catalogue.captures.put(row)
    names, cursor = [], None
    while True:
        page = catalogue.capture_page(3, cursor)
        names += [row.name for row in page.items]
        cursor = page.next_cursor
        if cursor is None:
            break
    assert names == [f"room {number}" for number in reversed(range(7))]
    assert [row.name for row in catalogue.capture_page(query="ROOM 3").items] == ["room 3"]
    assert catalogue.capture_page(query="%").items == []
    assert catalogue.capture_page(state=CaptureState.COMPLETE).items == []
    catalogue.captures.set(rows[2].id, deleted_at=NOW)
    assert len(catalogue.capture_page().items) == 6
    assert [row.id for row in catalogue.capture_page(deleted=True).items] == [rows[2].id]


def test_changes_from_many_threads_are_all_kept(catalogue: Catalogue) -> None:
    row = capture()
    catalogue.captures.put(row)

    def count() -> None:
        for _ in range(50):
            catalogue.captures.change(row.id, lambda old: replace(old, frames_planned=(old.frames_planned or 0) + 1))

    threads = [threading.Thread(target=count) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert catalogue.captures.get(row.id).frames_planned == 200


def test_threads_that_come_and_go_leave_no_open_files(catalogue: Catalogue, tmp_path: Path) -> None:
    def files() -> int:
        return sum(one.path.startswith(str(tmp_path)) for one in psutil.Process().open_files())

    catalogue.captures.where()
    before = files()
    gc.disable()  # as in a service that makes no garbage for minutes
    try:
        for _ in range(20):
            thread = threading.Thread(target=catalogue.captures.where)
            thread.start()
            thread.join()
        assert files() == before
    finally:
        gc.enable()
    with pytest.raises(StoreError):
        catalogue.read("SELECT nothing FROM nowhere")
    catalogue.close()
    assert files() == 0


def test_an_exception_in_a_transaction_undoes_all_of_it(catalogue: Catalogue) -> None:
    row = capture()
    with pytest.raises(RuntimeError), catalogue.transaction():
        catalogue.captures.put(row)
        catalogue.reconstructions.put(job(row.id))
        raise RuntimeError
    assert catalogue.captures.find(row.id) is None
    assert catalogue.reconstruction_page(capture_id=row.id).items == []
    with pytest.raises(UnknownIdError, match=row.id):
        catalogue.captures.set(row.id, name="x")


def test_versions_are_those_that_are_kept(catalogue: Catalogue) -> None:
    one = job("c")
    for version in range(1, 6):
        kept = {version, version - 1, 1}
        catalogue.put_version(VersionRow(one.id, version, NOW, 10, 20, 0.3, 1000), kept)
    assert [row.version for row in catalogue.versions(one.id)] == [1, 4, 5]
    catalogue.forget_versions(one.id)
    assert catalogue.versions(one.id) == []


def test_a_broken_file_is_told_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "c.sqlite").write_bytes(b"not a database" * 100)
    with pytest.raises(StoreError, match=r"c\.sqlite cannot be used"):
        Catalogue(tmp_path / "c.sqlite")


def test_a_catalogue_of_a_newer_version_is_left_alone(tmp_path: Path) -> None:
    Catalogue(tmp_path / "c.sqlite").close()
    with sqlite3.connect(tmp_path / "c.sqlite") as connection:
        connection.execute("PRAGMA user_version = 99")
    with pytest.raises(StoreError, match="newer spiked"):
        Catalogue(tmp_path / "c.sqlite")
