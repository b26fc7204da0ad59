"""Backup of the catalogue while a service uses it, and restore."""

import os
import sqlite3
from contextlib import closing, suppress
from datetime import UTC, datetime
from pathlib import Path
from urllib.parse import quote

from spiked_service.store.catalogue import Catalogue, DamagedError, StoreError
from spiked_service.store.folder import DataFolder
from spiked_service.store.migrations import schema_of


def back_up(catalogue: Path, target: Path | None = None) -> Path:
    """Copy a catalogue as it is at one moment, into one file; a service may go on writing it.

    Without a target the copy lies in `backups` beside the catalogue. Raises StoreError.
    """
    folder = catalogue.parent / "backups"
    target = target or folder / f"catalogue-{datetime.now(UTC):%Y%m%dT%H%M%S.%fZ}.sqlite"
    part = target.with_name(target.name + ".part")
    if target.exists():
        raise StoreError(f"{target} exists already: choose another name")
    try:
        if target.parent == folder:
            folder.mkdir(mode=0o700, exist_ok=True)
        source = sqlite3.connect(f"file:{quote(str(catalogue))}?mode=ro", uri=True)
        try:
            copy = sqlite3.connect(part)
            try:
                source.backup(copy)
            finally:
                copy.close()
        finally:
            source.close()
        _check(part, target)
        _sync(part)
        part.replace(target)
    except (OSError, sqlite3.Error) as error:
        part.unlink(missing_ok=True)
        raise StoreError(f"{catalogue} cannot be copied to {target}: {_why(error)}") from error
    return target


def restore(folder: DataFolder, backup: Path | None = None) -> tuple[Path, Path | None]:
    """Make a copy, without one the newest in `backups`, the catalogue of a data folder that no service uses.

    Returns the copy, and under which name the catalogue before it was kept, None if there was none. Raises StoreError.
    """
    if backup is None:
        found = sorted((folder.path / "backups").glob("catalogue-*.sqlite"))
        if not found:
            raise StoreError(f"there is no backup in {folder.path / 'backups'}: name the file")
        backup = found[-1]
    part = folder.catalogue.with_name(folder.catalogue.name + ".part")
    try:
        part.write_bytes(backup.read_bytes())
        _check_origin(part, backup)
        _check(part, backup)
        _sync(part)
        before = folder.set_catalogue_aside("before-restore") if folder.catalogue.exists() else None
        part.replace(folder.catalogue)
    except (OSError, sqlite3.Error) as error:
        raise StoreError(f"{backup} cannot be restored: {_why(error)}") from error
    finally:
        part.unlink(missing_ok=True)
    return backup, before


def _check_origin(path: Path, shown: Path) -> None:
    """Raises StoreError for an empty file and the database of another program, of which a catalogue could be made."""
    with suppress(sqlite3.DatabaseError), closing(sqlite3.connect(path)) as connection:  # damage is for `_check`
        if schema_of(connection) == 0:
            raise StoreError(f"{shown} is no catalogue of spiked: name a file that `spiked backup` has written")


def _why(error: OSError | sqlite3.Error) -> str:
    return error.strerror or str(error) if isinstance(error, OSError) else str(error)


def _check(path: Path, shown: Path) -> None:
    """Raises StoreError for what is no whole catalogue of this version or an earlier one; `shown` is its name."""
    try:
        catalogue = Catalogue(path)
        damage = catalogue.damage()
        catalogue.close()
    except DamagedError as error:
        damage = str(error.__cause__)
    if damage is not None:
        raise StoreError(f"{shown} is no whole catalogue: {damage}")


def _sync(path: Path) -> None:
    file = os.open(path, os.O_RDONLY)
    try:
        os.fsync(file)
    finally:
        os.close(file)
