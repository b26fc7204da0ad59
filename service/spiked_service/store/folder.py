"""The data folder: one owner at a time, one place that knows where everything lies."""

import fcntl
import os
import shutil
from dataclasses import dataclass
from pathlib import Path

from spiked.errors import ConfigurationError
from spiked_service.ids import is_id

_LOCK = "lock"


@dataclass(frozen=True)
class Space:
    """The disk below the data folder."""

    free_bytes: int
    """What a user may still write."""
    total_bytes: int


class DataFolder:
    """`catalogue.sqlite`, `captures/<id>`, `reconstructions/<id>` and `uploads/<id>.part` below one path.

    Its owner holds a lock that the kernel lets go of when the owner dies in whatever way.
    """

    def __init__(self, path: Path | None = None) -> None:
        """Make it where it is not there, and own it. Raises ConfigurationError."""
        self.path = (path or default_folder()).absolute()
        try:
            for folder in (self.path, self._captures, self._reconstructions, self._uploads):
                folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            self._lock = (self.path / _LOCK).open("w")
        except OSError as error:
            raise ConfigurationError(
                f"the data folder {self.path} cannot be used: {error.strerror}; choose another with --data"
            ) from error
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            self._lock.close()
            raise ConfigurationError(
                f"another service uses the data folder {self.path}: end it, or choose another folder with --data"
            ) from error

    @property
    def catalogue(self) -> Path:
        """The SQLite file."""
        return self.path / "catalogue.sqlite"

    def capture(self, capture_id: str) -> Path:
        """Folder of a capture. Raises ValueError for what is no id, so that no text from outside becomes a path."""
        return self._captures / _checked(capture_id)

    def recording(self, capture_id: str) -> Path:
        """The `.dat` of a capture; its sidecar and index lie beside it."""
        return self.capture(capture_id) / "recording.dat"

    def thumbnail(self, capture_id: str) -> Path:
        """A small picture of a capture, WebP; not there before frames came."""
        return self.capture(capture_id) / "thumbnail.webp"

    def reconstruction(self, reconstruction_id: str) -> Path:
        """Folder of a reconstruction: its versions, timeline and log."""
        return self._reconstructions / _checked(reconstruction_id)

    def upload(self, upload_id: str) -> Path:
        """What has come of an upload."""
        return self._uploads / f"{_checked(upload_id)}.part"

    def space(self) -> Space:
        """How full the disk is."""
        stat = os.statvfs(self.path)
        return Space(stat.f_bavail * stat.f_frsize, stat.f_blocks * stat.f_frsize)

    def contents(self) -> tuple[set[str], set[str], set[str]]:
        """Ids of the captures, reconstructions and uploads that have files, whatever the catalogue says."""
        return (
            {entry.name for entry in self._captures.iterdir() if is_id(entry.name)},
            {entry.name for entry in self._reconstructions.iterdir() if is_id(entry.name)},
            {entry.stem for entry in self._uploads.iterdir() if is_id(entry.stem)},
        )

    def remove(self, folder: Path) -> None:
        """Remove a capture's or reconstruction's folder with all in it; fine if it is gone."""
        # Renamed first, so that a kill in between never leaves half a capture under its name.
        doomed = folder.with_name(f".{folder.name}.removed")
        if folder.exists():
            folder.rename(doomed)
        shutil.rmtree(doomed, ignore_errors=True)

    def sweep(self) -> int:
        """Remove what killed processes left half-done, and say how many files and folders that was."""
        removed = 0
        for base in (self._captures, self._reconstructions):
            for doomed in base.glob(".*.removed"):
                shutil.rmtree(doomed, ignore_errors=True)
                removed += 1
            for part in base.glob("*/*.part"):
                part.unlink(missing_ok=True)
                removed += 1
        return removed

    def close(self) -> None:
        """Let go of it."""
        self._lock.close()

    @property
    def _captures(self) -> Path:
        return self.path / "captures"

    @property
    def _reconstructions(self) -> Path:
        return self.path / "reconstructions"

    @property
    def _uploads(self) -> Path:
        return self.path / "uploads"


def default_folder() -> Path:
    """`$XDG_DATA_HOME/spiked`, or `~/.local/share/spiked`."""
    base = os.environ.get("XDG_DATA_HOME")
    return (Path(base) if base else Path.home() / ".local" / "share") / "spiked"


def _checked(text: str) -> str:
    if not is_id(text):
        raise ValueError(f"{text!r} is not an id")
    return text
