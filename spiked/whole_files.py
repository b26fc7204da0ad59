"""Files and folders that appear whole or not at all, on a full disk, too."""

import errno
import io
import os
import secrets
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any

from spiked.errors import SceneError

__all__ = ["FULL", "KeptErrors", "whole_file", "whole_folder", "write_atomically"]

FULL = (errno.ENOSPC, errno.EDQUOT)
"""Error numbers of a full disk, and of a quota."""
_PART = ".spiked-{}.part"
"""Name of what is not yet whole."""


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A path beside `path` to write to, which replaces it at the end.

    After an error what was written is removed, and an earlier file is as it was. A link stays a link, and the file
    keeps its mode. A device or a pipe is written to directly. Raises OSError; that of a full disk says how much was
    written.
    """
    path = path.resolve()
    if path.exists() and not path.is_file():
        yield path
        return
    part = path.with_name(_part_name())
    try:
        # No wider than it will be: what is written may be a secret.
        part.touch(path.stat().st_mode & 0o777 if path.exists() else 0o666, exist_ok=False)
        with _amount_told(part):
            yield part
            _sync(part)
        if path.exists():
            part.chmod(path.stat().st_mode & 0o7777)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


@contextmanager
def whole_folder(path: Path, replaces: Sequence[str] = (), stale: Sequence[str] = ()) -> Iterator[Path]:
    """An empty folder of the same name to fill, which becomes `path` at the end.

    After an error what was written is removed, and an earlier folder is as it was. Of an earlier folder the files of
    the same names are replaced, those that match a pattern of `stale` are removed, and the others stay; with `replaces`
    the files that match these patterns are replaced, and there may be no others. Raises SceneError if there are, and
    OSError; that of a full disk says how much was written.
    """
    path = path.resolve()
    earlier = path.is_dir()
    _check_alone(path, replaces)
    made = () if earlier else _make_parents(path.parent)
    part = (path if earlier else path.parent) / _part_name()
    try:
        part.mkdir()
        folder = part / path.name
        folder.mkdir()
        with _amount_told(folder):
            yield folder
            _sync(folder)
        if earlier:
            _move(folder, path, (*replaces, *stale))
        else:
            folder.replace(path)
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)
        for parent in reversed(made):
            parent.rmdir()
        raise
    shutil.rmtree(part)


class KeptErrors(io.FileIO):
    """A file opened for writing that keeps its first OSError of writing until it is closed by its `with`.

    Libraries in other languages crash or hang if a write fails; to them it always succeeds. Raises OSError from
    `check()` and at the end of the `with`, whatever other error left it.
    """

    def __init__(self, path: Path, mode: str = "w") -> None:
        """`mode` as of io.FileIO. Raises OSError."""
        super().__init__(path, mode)
        self.error: OSError | None = None
        """The first one."""

    def write(self, data: Any, /) -> int:
        """Write all bytes; returns their number and moves on by it after an error, too."""
        left = memoryview(data).cast("B")
        size, end = len(left), self.tell() + len(left)
        while left and self.error is None:
            try:
                left = left[super().write(left) or 0 :]
            except OSError as error:
                self.error = error
        if self.error is not None:
            self.seek(end)
        return size

    def truncate(self, size: int | None = None, /) -> int:
        """Set the size; returns it after an error, too."""
        wanted = self.tell() if size is None else size
        if self.error is None:
            try:
                return super().truncate(wanted)
            except OSError as error:
                self.error = error
        return wanted

    def check(self) -> None:
        """Raises the OSError that was kept, if any: between two long steps."""
        if self.error is not None:
            raise self.error

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
        if not isinstance(error, KeyboardInterrupt | SystemExit):  # panics of Rust are no Exceptions
            self.check()


@contextmanager
def _amount_told(part: Path) -> Iterator[None]:
    """Add to the error of a full disk how much of the file or folder it took."""
    try:
        yield
    except OSError as error:
        if error.errno not in FULL:
            raise
        taken = sum(file.stat().st_size for file in (part, *part.rglob("*")) if file.is_file())
        after = f" after {taken / 2**20:.1f} MiB" if taken > 2**20 / 10 else ""
        raise OSError(error.errno, f"{os.strerror(error.errno)}{after}") from error


def _part_name() -> str:
    return _PART.format(secrets.token_hex(4))


def _make_parents(folder: Path) -> tuple[Path, ...]:
    """Make a folder and those above it; returns those that were missing, the highest first."""
    missing = tuple(reversed([place for place in (folder, *folder.parents) if not place.exists()]))
    folder.mkdir(parents=True, exist_ok=True)
    return missing


def _sync(part: Path) -> None:
    """Bring a file, or all files of a folder, to the disk: some file systems notice only then that they are full."""
    for file in (part, *part.rglob("*")):
        if file.is_file():
            with file.open("rb") as opened:
                os.fsync(opened.fileno())


def _check_alone(path: Path, replaces: Sequence[str]) -> None:
    """Raises SceneError if the folder holds files that match none of the patterns, unless there is no pattern."""
    known = (*replaces, _PART.format("*"))  # a part may be left by a process that was killed
    strange = sorted(file.name for file in path.glob("*") if not any(map(file.match, known)))
    if replaces and strange:
        raise SceneError(f"{path} holds {strange[0]}, and this format has a folder of its own; choose another one")


def _move(folder: Path, path: Path, replaces: Sequence[str]) -> None:
    """Move all files of a folder into another one, and remove those that match the patterns from it."""
    moved = set()
    for file in sorted(folder.rglob("*")):
        place = path / file.relative_to(folder)
        if file.is_dir():
            place.mkdir(exist_ok=True)
        else:
            file.replace(place)
            moved.add(place)
    for pattern in replaces:
        for file in path.glob(pattern):
            if file not in moved:
                file.unlink()


def write_atomically(path: Path, content: bytes) -> None:
    """Replace a file in one step: readers see the old or the new content, also after a power cut. Raises OSError."""
    part = path.with_name(path.name + ".part")
    try:
        with part.open("wb") as file:
            file.write(content)
            file.flush()
            os.fdatasync(file.fileno())
        part.replace(path)
    except OSError:
        part.unlink(missing_ok=True)  # of a full disk: what is left of it is not taken, too
        raise
