"""Reconciles the catalogue with the files of the data folder when the service starts."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError

from spiked_service.results.published import Published
from spiked_service.results.versions import version_row
from spiked_service.store.catalogue import Catalogue, DamagedError, StoreError, Table
from spiked_service.store.folder import DataFolder
from spiked_service.store.row_copies import outdated, read_copy
from spiked_service.store.rows import CaptureRow, Origin

_Row = TypeVar("_Row")
Log = Callable[[str, str], None]
"""Called with a level and a message."""


@dataclass(frozen=True)
class Orphans:
    """Ids with files but without a catalogue row or a readable copy of one."""

    captures: tuple[str, ...]
    reconstructions: tuple[str, ...]
    uploads: tuple[str, ...]


def open_catalogue(folder: DataFolder, log: Log) -> Catalogue:
    """Open the catalogue of a data folder. A damaged one is renamed and replaced by a new one.

    Raises StoreError if the catalogue cannot be used for another reason.
    """
    try:
        catalogue = Catalogue(folder.catalogue, folder)
        damage = catalogue.damage()
    except DamagedError as error:
        catalogue, damage = None, str(error.__cause__)
    if catalogue is not None and damage is None:
        return catalogue
    try:
        aside = folder.set_catalogue_aside("damaged")
    except OSError as error:
        raise StoreError(f"{damage}; and it cannot be renamed: {error.strerror}") from error
    finally:
        if catalogue is not None:
            catalogue.close()
    log("error", f"the catalogue is damaged ({damage}): it is kept as {aside}, and a new one is made from the files")
    return Catalogue(folder.catalogue, folder)


def reconcile(folder: DataFolder, catalogue: Catalogue, log: Log) -> Orphans:
    """Restore rows that are missing or older than their copy beside the files, and write missing copies.

    Return what has neither row nor copy. Call before any other use of the catalogue.
    """
    captures, reconstructions, uploads = folder.contents()
    return Orphans(
        _reconcile(catalogue.captures, captures, folder.capture_row, log, _mark_recovered),
        _reconcile(catalogue.reconstructions, reconstructions, folder.reconstruction_row, log, _same),
        _reconcile(catalogue.uploads, uploads, folder.upload_row, log, _same),
    )


def note_versions(catalogue: Catalogue, reconstruction_id: str, published: Sequence[Published]) -> bool:
    """Set the versions of a reconstruction in the catalogue to those in its folder; whether there are any.

    Raises StoreError.
    """
    kept = {one.version for one in published}
    if kept == catalogue.version_numbers(reconstruction_id):
        return bool(kept)
    if not kept:
        with catalogue.transaction():
            catalogue.forget_versions(reconstruction_id)
    for one in published:
        catalogue.put_version(version_row(reconstruction_id, one), kept)
    return bool(kept)


def _reconcile(
    table: Table[Any], ids: set[str], copy_of: Callable[[str], Path], log: Log, rebuilt: Callable[[Any], Any]
) -> tuple[str, ...]:
    """Reconcile one table; `rebuilt` makes the row to restore from the copy of a missing one."""
    known = table.documents()
    orphans, missing, stale = [], 0, 0
    for row_id in sorted(ids):
        try:
            path = copy_of(row_id)
            before, copy = known.get(row_id), read_copy(path)
            if copy is not None and before is not None and copy == before.encode():
                continue
            row = None if copy is None else _parsed(table, row_id, copy, path, log)
            if before is None and row is None and (copy := read_copy(outdated(path))) is not None:
                row = _parsed(table, row_id, copy, outdated(path), log)
            if before is None and row is None:
                orphans.append(row_id)
            elif before is None:
                table.put(rebuilt(row))
                missing += 1
            elif row is None:
                table.put(table.parse(before))
            elif row != table.parse(before):
                table.put(row)
                stale += 1
        except (StoreError, OSError) as error:
            log("error", f"{table.kind} {row_id} cannot be checked: {error}")
    if missing:
        log(
            "warning",
            f"{table.kind}s missing in the catalogue and restored from their files: {missing}",
        )
    if stale:
        log(
            "warning",
            f"{table.kind}s out of date in the catalogue and updated from their files: {stale}",
        )
    return tuple(orphans)


def _parsed(table: Table[Any], row_id: str, copy: bytes, path: Path, log: Log) -> Any | None:
    """The row of a copy; an unreadable copy is renamed. Raises OSError."""
    try:
        row = table.parse(copy)
        if row.id == row_id:
            return row
        problem = f"it belongs to {row.id}"
    except ValidationError as error:
        problem = str(error.errors()[0]["msg"])
    aside = path.rename(path.with_name(f"{path.name}.unreadable"))
    log("error", f"the row beside {table.kind} {row_id} cannot be read ({problem}); it is kept as {aside}")
    return None


def _mark_recovered(row: CaptureRow) -> CaptureRow:
    return replace(row, origin=Origin.RECOVERED)


def _same(row: _Row) -> _Row:
    return row
