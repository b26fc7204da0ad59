"""Retention: what goes, in which order, and what stays."""

from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from spiked_service.api.bus_notifier import BusNotifier
from spiked_service.base.ids import new_id
from spiked_service.captures.archive import DataStore
from spiked_service.daemon import open_data_store
from spiked_service.events.bus import Bus
from spiked_service.store import disk_use
from spiked_service.store.catalogue import StoreError
from spiked_service.store.disk_use import size_of
from spiked_service.store.retention import Policy
from spiked_service.store.rows import CaptureRow, CaptureState, JobState, Origin, Plan, ReconstructionRow, UploadRow
from waiting import until

from ...small_disk import fill, small_disk

NOW = datetime(2026, 11, 21, 12, 0, 0, 0, UTC)
MIB = 1 << 20


@pytest.fixture
def data_store(tmp_path: Path) -> Iterator[DataStore]:
    one = open_data_store(tmp_path / "data", BusNotifier(Bus()))
    yield one
    one.close()


def capture(data_store: DataStore, days_old: float, **more: object) -> str:
    """A capture with a recording of 1 MiB and a reconstruction of 1 MiB."""
    ended = NOW - timedelta(days=days_old)
    row = CaptureRow(new_id(), Origin.LIVE, Plan("sim:"), CaptureState.COMPLETE, ended, ended_at=ended)
    row = replace(row, **more)  # type: ignore[arg-type]
    data_store.catalogue.captures.put(row)
    data_store.folder.capture(row.id).mkdir()
    data_store.folder.recording(row.id).write_bytes(bytes(MIB))
    job = ReconstructionRow(new_id(), row.id, False, JobState.COMPLETE, ended)
    data_store.catalogue.reconstructions.put(job)
    data_store.folder.reconstruction(job.id).mkdir()
    (data_store.folder.reconstruction(job.id) / "scene-000001.ply").write_bytes(bytes(MIB))
    return row.id


def there(data_store: DataStore, *ids: str) -> list[bool]:
    return [data_store.catalogue.captures.find(one) is not None for one in ids]


def test_without_limits_everything_stays(data_store: DataStore) -> None:
    old = capture(data_store, 10_000)
    data_store.retention.apply(NOW)
    assert data_store.catalogue.captures.get(old).deleted_at is None


def test_old_ones_are_removed_then_gone_unless_kept_or_running(data_store: DataStore) -> None:
    data_store.retention.policy = Policy(days=30, deleted_days=7)
    old, young = capture(data_store, 31), capture(data_store, 29)
    kept, running = capture(data_store, 31, keep=True), capture(data_store, 31, state=CaptureState.STREAMING)
    data_store.retention.apply(NOW)
    assert data_store.catalogue.captures.get(old).deleted_at is not None
    assert there(data_store, old, young, kept, running) == [True] * 4
    assert [row.id for row in data_store.captures.list(deleted=True).items] == [old]
    assert data_store.captures.removal.restore(old).row.deleted_at is None
    data_store.captures.update(old, keep=True)
    data_store.retention.apply(NOW)
    assert data_store.catalogue.captures.get(old).deleted_at is None
    data_store.catalogue.captures.set(old, deleted_at=NOW - timedelta(days=6.9))
    data_store.retention.apply(NOW)
    assert there(data_store, old) == [True]
    data_store.catalogue.captures.set(old, deleted_at=NOW - timedelta(days=7))
    jobs = data_store.catalogue.reconstruction_page(capture_id=old).items
    data_store.retention.apply(NOW)
    assert there(data_store, old, young, kept, running) == [False, True, True, True]
    assert not data_store.folder.capture(old).exists()
    until(lambda: not data_store.folder.reconstruction(jobs[0].id).exists(), "its jobs are deleted")
    assert data_store.catalogue.reconstruction_page(capture_id=old).items == []


def test_beyond_a_size_removed_ones_go_first_then_the_oldest(data_store: DataStore) -> None:
    kept = capture(data_store, 5, keep=True)
    oldest, older, deleted = capture(data_store, 4), capture(data_store, 3), capture(data_store, 2, deleted_at=NOW)
    youngest = capture(data_store, 1)
    assert sum(data_store.retention.disk_use.by_capture().values()) >= 10 * MIB
    for limit, expected in (
        (11, [True, True, True, True, True]),
        (9, [True, True, True, False, True]),
        (7, [True, False, True, False, True]),
        (3, [True, False, False, False, False]),
    ):
        data_store.retention.policy = Policy(bytes=limit * MIB)
        data_store.retention.apply(NOW)
        assert there(data_store, kept, oldest, older, deleted, youngest) == expected


def test_uploads_that_nobody_goes_on_with_are_dropped(data_store: DataStore) -> None:
    stale, fresh = (
        UploadRow(new_id(), "a.dat", 10, NOW - timedelta(days=days), NOW - timedelta(days=days)) for days in (1.1, 0.9)
    )
    for row in (stale, fresh):
        data_store.catalogue.uploads.put(row)
        data_store.folder.upload(row.id).touch()
    data_store.retention.apply(NOW)
    assert [row.id for row in data_store.catalogue.uploads.where()] == [fresh.id]
    assert data_store.folder.contents()[2] == {fresh.id}


def test_on_a_full_disk_captures_are_removed_and_purged(tmp_path: Path) -> None:
    with small_disk(tmp_path / "data", 16) as disk, closing(open_data_store(disk, BusNotifier(Bus()))) as data_store:
        reserve = disk / "catalogue.sqlite-reserve"
        assert reserve.stat().st_blocks * 512 == 16 * MIB // 64
        old, unwanted, young = (capture(data_store, days) for days in (40, 20, 1))
        others = fill(disk)
        with pytest.raises(StoreError, match="full"):
            data_store.catalogue.captures.set(young, notes="x" * 10_000)
        assert reserve.exists()
        assert data_store.captures.removal.remove(unwanted).row.deleted_at is not None
        assert not reserve.exists()
        data_store.catalogue.keep_reserve()
        assert not reserve.exists(), "there is no room for it yet"
        others.unlink()
        data_store.catalogue.keep_reserve()
        assert reserve.exists()

        fill(disk)
        data_store.retention.policy = Policy(days=30, deleted_days=0)
        data_store.retention.apply(datetime.now(UTC) + timedelta(seconds=1))
        assert there(data_store, old, unwanted, young) == [True, False, True]
        assert data_store.catalogue.captures.get(old).deleted_at is not None


def walked(data_store: DataStore, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of folders that are measured from now on."""
    names: list[str] = []

    def noted(folder: Path) -> int:
        names.append(folder.name)
        return size_of(folder)

    monkeypatch.setattr(disk_use, "size_of", noted)
    monkeypatch.setattr(disk_use, "_AGAIN", 2)
    return names


def test_what_is_on_disk_is_measured_once_and_then_where_it_changes(
    data_store: DataStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    until(lambda: data_store.check_catalogue()[1] == "", "the start is over")
    ids = [capture(data_store, 1) for _ in range(20)]
    (job,) = data_store.catalogue.reconstruction_page(capture_id=ids[0]).items
    use, names = data_store.retention.disk_use, walked(data_store, monkeypatch)
    first = use.by_capture()
    assert len(names) == 40 and set(first) == set(ids) and min(first.values()) >= 2 * MIB
    names.clear()
    assert use.by_capture() == first and len(names) <= 2, "others in turn"
    names.clear()
    (data_store.folder.reconstruction(job.id) / "scene-000002.ply").write_bytes(bytes(3 * MIB))
    data_store.catalogue.reconstructions.set(job.id, version=2)
    assert use.by_capture()[ids[0]] >= 5 * MIB and job.id in names and len(names) <= 3
    data_store.captures.removal.purge(ids[1])
    data_store.reconstructions.remove(job.id)
    until(lambda: not data_store.catalogue.read("SELECT 1 FROM purges"), "it is deleted")
    now = use.by_capture()
    assert set(now) == {*ids} - {ids[1]} and now[ids[0]] < 2 * MIB
    names.clear()
    new = capture(data_store, 0)
    assert use.by_capture()[new] >= 2 * MIB and len(names) <= 4
    data_store.catalogue.captures.set(new, state=CaptureState.STREAMING)
    use.by_capture()
    names.clear()
    data_store.folder.recording(new).write_bytes(bytes(4 * MIB))
    assert use.by_capture()[new] >= 5 * MIB and len(names) <= 3, "it grows without a row"
    (data_store.folder.capture(ids[5]) / "notes").write_bytes(bytes(MIB))  # by somebody
    assert any(use.by_capture()[ids[5]] >= 3 * MIB for _ in range(30)), "it is found in its turn"
    known = use.by_capture()
    use.forget()
    assert use.by_capture() == known


def test_applying_a_policy_reads_only_the_captures_that_it_is_about(
    data_store: DataStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    until(lambda: data_store.check_catalogue()[1] == "", "the start is over")
    ids = [capture(data_store, 10) for _ in range(30)]
    old, removed = capture(data_store, 31), capture(data_store, 40, deleted_at=NOW - timedelta(days=8))
    read: list[str] = []
    find = data_store.catalogue.captures.find

    def noted(row_id: str) -> CaptureRow | None:
        read.append(row_id)
        return find(row_id)

    monkeypatch.setattr(data_store.catalogue.captures, "find", noted)
    data_store.retention.policy = Policy(days=30, deleted_days=7, bytes=100 * MIB)
    data_store.retention.apply(NOW)
    assert set(read) == {old, removed} and there(data_store, *ids, removed) == [True] * 30 + [False]
    read.clear()
    data_store.retention.policy = Policy(bytes=60 * MIB)
    data_store.retention.apply(NOW)
    assert 1 <= len(set(read)) <= 3, "the oldest, until the others are below the limit"
    data_store.retention.policy = Policy(days=1e6)
    data_store.retention.apply(NOW)
