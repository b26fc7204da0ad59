"""Copies of rows beside the files: in step with the catalogue, whatever fails."""

import json
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pytest
from spiked_service.base.ids import new_id
from spiked_service.captures.reconcile import reconcile
from spiked_service.store.catalogue import Catalogue, StoreError
from spiked_service.store.folder import DataFolder
from spiked_service.store.row_copies import outdated
from spiked_service.store.rows import CaptureRow, CaptureState, Origin, Plan

from ...small_disk import fill, small_disk

ROW = CaptureRow(new_id(), Origin.LIVE, Plan("sim:"), CaptureState.COMPLETE, datetime(2026, 11, 25, tzinfo=UTC), "desk")


def opened(folder: Path) -> tuple[DataFolder, Catalogue]:
    data = DataFolder(folder)
    data.capture(ROW.id).mkdir(parents=True, exist_ok=True)
    return data, Catalogue(data.catalogue, data)


def name_in(path: Path) -> str:
    return str(json.loads(path.read_text())["name"])


def test_a_copy_changes_with_the_transaction_or_not_at_all(tmp_path: Path) -> None:
    data, catalogue = opened(tmp_path / "data")
    copy = data.capture_row(ROW.id)
    catalogue.captures.put(ROW)
    assert name_in(copy) == "desk"
    with pytest.raises(ZeroDivisionError), catalogue.transaction():
        catalogue.captures.set(ROW.id, name="chair")
        raise ZeroDivisionError
    assert name_in(copy) == "desk" == catalogue.captures.get(ROW.id).name
    with pytest.raises(ZeroDivisionError), catalogue.transaction():
        catalogue.captures.remove(ROW.id)
        raise ZeroDivisionError
    assert name_in(copy) == "desk" == catalogue.captures.get(ROW.id).name
    with catalogue.transaction():
        catalogue.captures.set(ROW.id, name="chair")
        catalogue.captures.set(ROW.id, name="table")
        assert name_in(copy) == "desk"
    assert name_in(copy) == "table"
    catalogue.captures.remove(ROW.id)
    assert list(copy.parent.iterdir()) == []


def test_a_full_disk_takes_no_copy_away(tmp_path: Path) -> None:
    with small_disk(tmp_path / "data", 4) as disk:
        data, catalogue = opened(disk)
        copy = data.capture_row(ROW.id)
        catalogue.captures.put(ROW)
        before = copy.read_bytes()
        fill(disk)
        refused = 0
        # Until the log of the catalogue is full, too, rows change without their copies.
        while not refused and catalogue.captures.get(ROW.id).notes.count("x") < 4000:
            more = catalogue.captures.get(ROW.id).notes + 40 * "x"
            try:
                catalogue.captures.set(ROW.id, notes=more)
            except StoreError:
                refused += 1
                assert catalogue.captures.get(ROW.id).notes == more[40:]
        assert refused
        kept = [path.read_bytes() for path in (copy, outdated(copy)) if path.exists()]
        assert before in kept, "the last state that had room"
        assert not list(copy.parent.glob("*.part"))
        catalogue.close()
        data.close()


def test_an_outdated_copy_serves_only_when_all_else_is_lost(tmp_path: Path) -> None:
    data, catalogue = opened(tmp_path / "data")
    copy = data.capture_row(ROW.id)
    catalogue.captures.put(ROW)
    copy.with_name(f"{copy.name}.part").mkdir()  # so that no copy can be written
    catalogue.captures.set(ROW.id, name="chair")
    assert not copy.exists() and name_in(outdated(copy)) == "desk"
    log = list[str]()
    assert not reconcile(data, catalogue, lambda _, text: log.append(text)).captures
    assert catalogue.captures.get(ROW.id).name == "chair", "the row is newer"
    copy.with_name(f"{copy.name}.part").rmdir()

    catalogue.close()
    data.catalogue.unlink()
    catalogue = Catalogue(data.catalogue, data)
    assert not reconcile(data, catalogue, lambda _, text: log.append(text)).captures
    restored = catalogue.captures.get(ROW.id)
    assert restored == replace(ROW, origin=Origin.RECOVERED), "better than a recording without a name"
    assert "restored from their files: 1" in log[-1]
    assert name_in(copy) == "desk" and not outdated(copy).exists()
    catalogue.close()
    data.close()
