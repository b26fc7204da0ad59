"""Checks of output paths before the work begins, so that a mistyped path does not lose hours of work."""

import errno
import fcntl
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from spiked.errors import ConfigurationError

_OF_RECORDINGS = (".dat", ".json", ".index")
"""Suffixes of a recording's files."""
_LOCK = ".lock"
"""In a folder that one command at a time may work in."""


def try_folder(option: str, folder: Path, files: tuple[str, ...] = ()) -> None:
    """Check that a folder can be made or written to, and these files in it. Leaves nothing behind.

    Raises ConfigurationError.
    """
    with writing(option, folder):
        if folder.exists() and not folder.is_dir():
            raise ConfigurationError(f"{option} {folder} is a file; name a folder")
        nearest = next(place for place in (folder, *folder.absolute().parents) if place.exists())
        if not nearest.is_dir():
            raise ConfigurationError(f"{option} {folder} cannot be made: {nearest} is a file; name another folder")
        with tempfile.TemporaryFile(dir=nearest, prefix=".spiked-"):
            pass
    for name in files:
        if (folder / name).exists():
            try_file(option, folder / name)


def try_file(option: str, file: Path) -> None:
    """Check that a file can be written or overwritten. Nothing is created or changed. Raises ConfigurationError."""
    with writing(option, file):
        if file.is_dir():
            raise ConfigurationError(f"{option} {file} is a folder; name a file")
        if file.exists() and file.suffix in _OF_RECORDINGS and file.with_suffix(".dat").exists():
            raise ConfigurationError(f"{option} {file} is part of a recording and would be lost; name another file")
        if file.exists():
            os.close(os.open(file, os.O_WRONLY | os.O_APPEND))
            return
        if not file.parent.exists():
            raise ConfigurationError(
                f"{option} {file} cannot be written: the folder {file.parent} does not exist; make it"
            )
        with tempfile.TemporaryFile(dir=file.parent, prefix=".spiked-"):
            pass


@contextmanager
def alone(option: str, folder: Path, what: str) -> Iterator[None]:
    """Make a folder and keep other commands out of it. Raises ConfigurationError if one works there, and OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / _LOCK).open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise ConfigurationError(
                f"{option} {folder}: another {what} works there; wait for it, or name another folder"
            ) from error
        yield


@contextmanager
def writing(option: str, place: Path) -> Iterator[None]:
    """Turn an error of writing to `place` into one that names the option and the place, and says what to do.

    Raises ConfigurationError.
    """
    try:
        yield
    except OSError as error:
        why = error.strerror or error
        advice = "free disk space" if error.errno in (errno.ENOSPC, errno.EDQUOT) else "make this one writable"
        raise ConfigurationError(
            f"{option} {place} cannot be written: {why}; name another place, or {advice}"
        ) from error
