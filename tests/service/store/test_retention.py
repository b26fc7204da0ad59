"""Retention: what goes, in which order, and what stays."""

from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from spiked_service.api.announce import BusAnnouncer
from spiked_service.events import Bus
from spiked_service.ids import new_id
from spiked_service.keeping import Keeping
from spiked_service.store.retention import Policy
from spiked_service.store.rows import CaptureRow, CaptureState, JobState, Origin, Plan, ReconstructionRow, UploadRow

NOW = datetime(2026, 11, 21, 12, 0, 0, 0, UTC)
MIB = 1 << 20


@pytest.fixture
def keeping(tmp_path: Path) -> Iterator[Keeping]:
    one = Keeping(tmp_path / "data", BusAnnouncer(Bus()))
    yield one
    one.close()


def capture(keeping: Keeping, days_old: float, **more: object) -> str:
    """A capture with a recording of 1 MiB and a reconstruction of 1 MiB."""
    ended = NOW - timedelta(days=days_old)
    row = CaptureRow(new_id(), Origin.LIVE, Plan("sim:"), CaptureState.COMPLETE, ended, ended_at=ended)
    row = replace(row, **more)  # type: ignore[arg-type]
    keeping.catalogue.captures.put(row)
    keeping.folder.capture(row.id).mkdir()
    keeping.folder.recording(row.id).write_bytes(bytes(MIB))
    job = ReconstructionRow(new_id(), row.id, False, JobState.COMPLETE, ended)
    keeping.catalogue.reconstructions.put(job)
    keeping.folder.reconstruction(job.id).mkdir()
    (keeping.folder.reconstruction(job.id) / "scene-000001.ply").write_bytes(bytes(MIB))
    return row.id


def there(keeping: Keeping, *ids: str) -> list[bool]:
    return [keeping.catalogue.captures.find(one) is not None for one in ids]


def test_without_limits_everything_stays(keeping: Keeping) -> None:
    old = capture(keeping, 10_000)
    keeping.retention.apply(NOW)
    assert keeping.catalogue.captures.get(old).deleted_at is None


def test_old_ones_are_removed_then_gone_unless_kept_or_running(keeping: Keeping) -> None:
    keeping.retention.policy = Policy(days=30, deleted_days=7)
    old, young = capture(keeping, 31), capture(keeping, 29)
    kept, running = capture(keeping, 31, keep=True), capture(keeping, 31, state=CaptureState.STREAMING)
    keeping.retention.apply(NOW)
    assert keeping.catalogue.captures.get(old).deleted_at is not None
    assert there(keeping, old, young, kept, running) == [True] * 4
    assert [row.id for row in keeping.captures.list(deleted=True).items] == [old]
    assert keeping.captures.restore(old).row.deleted_at is None
    keeping.captures.update(old, keep=True)
    keeping.retention.apply(NOW)
    assert keeping.catalogue.captures.get(old).deleted_at is None
    keeping.catalogue.captures.set(old, deleted_at=NOW - timedelta(days=6.9))
    keeping.retention.apply(NOW)
    assert there(keeping, old) == [True]
    keeping.catalogue.captures.set(old, deleted_at=NOW - timedelta(days=7))
    jobs = keeping.catalogue.reconstructions_of(old)
    keeping.retention.apply(NOW)
    assert there(keeping, old, young, kept, running) == [False, True, True, True]
    assert not keeping.folder.capture(old).exists()
    assert not keeping.folder.reconstruction(jobs[0].id).exists()
    assert keeping.catalogue.reconstructions_of(old) == []


def test_beyond_a_size_removed_ones_go_first_then_the_oldest(keeping: Keeping) -> None:
    kept = capture(keeping, 5, keep=True)
    oldest, older, deleted = capture(keeping, 4), capture(keeping, 3), capture(keeping, 2, deleted_at=NOW)
    youngest = capture(keeping, 1)
    assert sum(keeping.retention.used_bytes().values()) >= 10 * MIB
    for limit, expected in (
        (11, [True, True, True, True, True]),
        (9, [True, True, True, False, True]),
        (7, [True, False, True, False, True]),
        (3, [True, False, False, False, False]),
    ):
        keeping.retention.policy = Policy(bytes=limit * MIB)
        keeping.retention.apply(NOW)
        assert there(keeping, kept, oldest, older, deleted, youngest) == expected


def test_uploads_that_nobody_goes_on_with_are_dropped(keeping: Keeping) -> None:
    stale, fresh = (
        UploadRow(new_id(), "a.dat", 10, NOW - timedelta(days=days), NOW - timedelta(days=days)) for days in (1.1, 0.9)
    )
    for row in (stale, fresh):
        keeping.catalogue.uploads.put(row)
        keeping.folder.upload(row.id).touch()
    keeping.retention.apply(NOW)
    assert [row.id for row in keeping.catalogue.uploads.where()] == [fresh.id]
    assert keeping.folder.contents()[2] == {fresh.id}
