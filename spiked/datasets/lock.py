"""Checksums of a data set: recorded when a folder is first looked at, compared with whenever it is looked at again.

The lock is `spiked-dataset.lock.json` in the folder, or, where that cannot be written, a file of the folder's name in
the user's data folder.
"""

import hashlib
import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError

from spiked.datasets.clip import Dataset
from spiked.errors import DatasetError

LOCK_NAME = "spiked-dataset.lock.json"
_ANY_WRITES = 0o222
"""Bits of a mode that let anybody write."""


class LockedFile(BaseModel):
    """What is recorded of a file."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    bytes: int
    sha256: str


class Lock(BaseModel):
    """The files of a data set when it was first looked at."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    dataset: str
    recorded: datetime
    files: dict[str, LockedFile]
    """By their paths in the folder."""


@dataclass(frozen=True)
class Comparison:
    """How a folder differs from its lock."""

    path: Path
    """Of the lock."""
    is_new: bool
    """It was recorded now."""
    recorded: datetime
    changed: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()
    added: tuple[str, ...] = ()

    def raise_if_changed(self, folder: Path) -> None:
        """Raises DatasetError that names the first file that is another one than at the first look, or is gone."""
        if not (self.changed or self.missing):
            return
        name, what = (self.changed[0], "has changed") if self.changed else (self.missing[0], "is missing")
        more = len(self.changed) + len(self.missing) - 1
        rest = f", and {more} more" if more else ""
        raise DatasetError(
            f"{folder / name} {what} since {self.recorded:%Y-%m-%d}{rest}: copy it anew, or if the change is meant, "
            f"remove {self.path}"
        )


def lock_path(folder: Path) -> Path:
    """Where the lock of a folder is, or will be."""
    beside = folder / LOCK_NAME
    elsewhere = _data_folder() / f"{hashlib.sha256(str(folder.resolve()).encode()).hexdigest()[:16]}.json"
    if beside.exists() or (_may_write(folder) and not elsewhere.exists()):
        return beside
    return elsewhere


def compare(dataset: Dataset, progress: Callable[[int, int], None] = lambda done, total: None) -> Comparison:
    """Record the checksums of a folder at the first look, else compare. Other files in the folder do not count.

    `progress` is called with the bytes read and those there are. Raises DatasetError for files that cannot be read.
    """
    path = lock_path(dataset.folder)
    before = _read(path) if path.exists() else None
    found = _checksums(dataset, before, progress)
    if before is None:
        lock = Lock(dataset=dataset.kind, recorded=datetime.now(UTC), files=found)
        _write(path, lock)
        return Comparison(path, True, lock.recorded)
    changed = [name for name, file in found.items() if name in before.files and before.files[name] != file]
    missing = [name for name in before.files if not (dataset.folder / name).is_file()]
    added = [name for name in found if name not in before.files]
    if added:
        _write(path, before.model_copy(update={"files": before.files | {name: found[name] for name in added}}))
    return Comparison(path, False, before.recorded, tuple(changed), tuple(missing), tuple(added))


def _may_write(folder: Path) -> bool:
    """Whether a folder may be written: one that is marked as read-only is left as it is, by root, too."""
    return os.access(folder, os.W_OK) and folder.stat().st_mode & _ANY_WRITES != 0


def _data_folder() -> Path:
    base = os.environ.get("XDG_DATA_HOME") or str(Path("~/.local/share").expanduser())
    return Path(base) / "spiked" / "datasets"


def _checksums(dataset: Dataset, before: Lock | None, progress: Callable[[int, int], None]) -> dict[str, LockedFile]:
    """The files by their paths in the folder. A file of another size than before is not read."""
    sizes = {}
    for path in dataset.files:
        try:
            sizes[path] = path.stat().st_size
        except OSError as error:
            raise DatasetError(f"{path}: cannot be read: {error.strerror}; copy it anew") from error
    total, done = sum(sizes.values()), 0
    found = {}
    for path, size in sizes.items():
        name = path.relative_to(dataset.folder).as_posix()
        known = None if before is None else before.files.get(name)
        if known is not None and known.bytes != size:
            found[name] = LockedFile(bytes=size, sha256="")
        else:
            found[name] = LockedFile(bytes=size, sha256=_sha256(path))
        done += size
        progress(done, total)
    return found


def _sha256(path: Path) -> str:
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read: {error.strerror}; copy it anew") from error


def _read(path: Path) -> Lock:
    try:
        return Lock.model_validate_json(path.read_bytes())
    except (OSError, ValidationError) as error:
        raise DatasetError(f"{path}: this lock of checksums cannot be read; remove it to record anew") from error


def _write(path: Path, lock: Lock) -> None:
    temporary = path.with_name(path.name + ".part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_text(json.dumps(json.loads(lock.model_dump_json()), indent=1), "utf-8")
        temporary.replace(path)
    except OSError as error:
        raise DatasetError(
            f"{path}: the checksums cannot be recorded: {error.strerror}; make the place writable"
        ) from error
