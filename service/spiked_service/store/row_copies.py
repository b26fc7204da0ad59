"""Copies of rows beside the files that they are about, in step with the transactions of the catalogue."""

from contextlib import suppress
from pathlib import Path

_OUTDATED = ".outdated"
"""Suffix of a copy whose row has changed since, on a disk that had no room for a newer one."""


class RowCopies:
    """What one transaction at a time does to the copies. Not safe for threads: the catalogue's lock is held.

    A copy is replaced after the commit, so that a change that was refused is in neither; a kill in between undoes a
    change that was not answered yet. A copy that cannot be written is put aside as outdated, because a copy otherwise
    wins over a row that differs from it.
    """

    def __init__(self) -> None:
        self._changes: dict[Path, bytes | None] = {}
        self._written: set[Path] = set()

    def put(self, path: Path, document: bytes) -> None:
        """Have a copy written, if its folder exists."""
        self._changes[path] = document

    def remove(self, path: Path) -> None:
        """Have a copy removed."""
        self._changes[path] = None

    def prepare(self) -> None:
        """Write what is new beside the copies: before the commit, so that little is left to be done after it."""
        for path, document in self._changes.items():
            try:
                if document is not None and path.parent.is_dir():
                    _part(path).write_bytes(document)
                    self._written.add(path)
            except OSError:
                with suppress(OSError):
                    _part(path).unlink(missing_ok=True)

    def place(self) -> None:
        """Bring the copies up to date with what was committed.

        Raises the first OSError of those that cannot be, when all others are.
        """
        errors = []
        for path, document in self._changes.items():
            try:
                if document is not None:
                    self._replace(path)
                else:
                    path.unlink(missing_ok=True)
                    outdated(path).unlink(missing_ok=True)
            except OSError as error:
                errors.append(error)
        self._forget()
        if errors:
            raise errors[0]

    def drop(self) -> None:
        """Leave the copies as they are: the transaction was rolled back."""
        for path in self._written:
            with suppress(OSError):  # swept at the next start
                _part(path).unlink(missing_ok=True)
        self._forget()

    def _replace(self, path: Path) -> None:
        try:
            if path in self._written:
                _part(path).replace(path)
                outdated(path).unlink(missing_ok=True)
            elif path.exists():
                path.replace(outdated(path))
        except OSError:
            path.unlink(missing_ok=True)  # rather than that it undoes the change at the next start

    def _forget(self) -> None:
        self._changes.clear()
        self._written.clear()


def read_copy(path: Path) -> bytes | None:
    """The copy of a row; None if there is none. Raises OSError."""
    try:
        return path.read_bytes()
    except (FileNotFoundError, NotADirectoryError):
        return None


def outdated(path: Path) -> Path:
    """Where an earlier state of a copy lies; it serves when both the row and a newer copy are lost."""
    return path.with_name(path.name + _OUTDATED)


def _part(path: Path) -> Path:
    return path.with_name(path.name + ".part")
