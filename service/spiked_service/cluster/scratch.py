"""Folders for the files of an attempt, on the disk of the machine that works for it."""

import fcntl
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

_PREFIX = "spiked-attempt-"
"""Of the names of the folders."""
_LOCK = ".lock"
"""File in a folder that its owner holds a lock of, which the kernel lets go of when the owner dies."""


def scratch_base() -> Path:
    """$SPIKED_SCRATCH, or the folder for temporary files."""
    return Path(os.environ.get("SPIKED_SCRATCH") or tempfile.gettempdir())


@contextmanager
def scratch_folder() -> Iterator[Path]:
    """A folder for an attempt, removed at the end. Those of agents that were killed are removed first."""
    base = scratch_base()
    for old in base.glob(f"{_PREFIX}*"):
        _remove_if_left(old)
    while True:
        folder = Path(tempfile.mkdtemp(prefix=_PREFIX, dir=base))
        with (folder / _LOCK).open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not (folder / _LOCK).exists():
                continue  # another agent has removed it before it was locked
            try:
                yield folder
            finally:
                shutil.rmtree(folder, ignore_errors=True)
        return


def _remove_if_left(folder: Path) -> None:
    with suppress(OSError), (folder / _LOCK).open("r+") as lock:  # in use, of another user, or not locked yet
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        shutil.rmtree(folder, ignore_errors=True)
