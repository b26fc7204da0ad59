"""The data folder: its lock and the paths of its files."""

import fcntl
import os
import shutil
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from spiked.errors import ConfigurationError
from spiked.recon.checkpoint_file import CHECKPOINT
from spiked_service.base.ids import is_id

_LOCK = "lock"
_REMOVED = ".removed"
"""Suffix of a hidden folder that is being deleted."""
CAPTURE_ROW = "capture.json"
"""Name of the copy of a capture's row in its folder."""
RECONSTRUCTION_ROW = "reconstruction.json"
"""Name of the copy of a reconstruction's row in its folder."""
UPLOAD_SUFFIXES = ".part", ".json", ".dat", ".npz"
"""Files of an upload: its bytes, sidecar, recording if it is converted, and calibration."""


@dataclass(frozen=True)
class Space:
    """Space on the disk of the data folder."""

    free_bytes: int
    """Bytes available to unprivileged users."""
    total_bytes: int


def nearest_folder(path: Path) -> Path:
    """The folder itself, or where it is missing the nearest one above that exists."""
    return next(each for each in (path.absolute(), *path.absolute().parents) if each.is_dir())


def space_at(path: Path) -> Space:
    """Space on the disk of a folder."""
    stat = os.statvfs(path)
    return Space(stat.f_bavail * stat.f_frsize, stat.f_blocks * stat.f_frsize)


class DataFolder:
    """`catalogue.sqlite`, `captures/<id>`, `reconstructions/<id>` and `uploads/<id>.part` below one path.

    Its owner holds a lock that the kernel lets go of when the owner dies in whatever way.
    """

    def __init__(self, path: Path | None = None) -> None:
        """Create the folder if it does not exist, and lock it. Raises ConfigurationError."""
        self.path = (path or default_folder()).absolute()
        try:
            for folder in (self.path, self._captures, self._reconstructions, self._uploads, self.profiles):
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

    @property
    def profiles(self) -> Path:
        """Folder of camera profiles, and of the calibrations that they name."""
        return self.path / "profiles"

    def capture(self, capture_id: str) -> Path:
        """Folder of a capture. Raises ValueError for text that is not an id, so that no client chooses a path."""
        return self._captures / _checked(capture_id)

    def recording(self, capture_id: str) -> Path:
        """The `.dat` of a capture; sidecar and index are beside it."""
        return self.capture(capture_id) / "recording.dat"

    def thumbnail(self, capture_id: str) -> Path:
        """Thumbnail of a capture, WebP; missing before the first frames."""
        return self.capture(capture_id) / "thumbnail.webp"

    def capture_row(self, capture_id: str) -> Path:
        """Copy of the catalogue's row of a capture."""
        return self.capture(capture_id) / CAPTURE_ROW

    def reconstruction(self, reconstruction_id: str) -> Path:
        """Folder of a reconstruction: its versions, timeline and log."""
        return self._reconstructions / _checked(reconstruction_id)

    def reconstruction_row(self, reconstruction_id: str) -> Path:
        """Copy of the catalogue's row of a reconstruction."""
        return self.reconstruction(reconstruction_id) / RECONSTRUCTION_ROW

    def checkpoint(self, reconstruction_id: str) -> Path:
        """Folder of the checkpoint of a reconstruction that has not ended; it may not exist."""
        return self.reconstruction(reconstruction_id) / CHECKPOINT

    def maps(self, reconstruction_id: str, count: int) -> list[Path]:
        """Folders of the maps that a job uses, linked; they exist until it has ended."""
        return [self.reconstruction(reconstruction_id) / f"map-{number}" for number in range(1, count + 1)]

    def given_poses(self, reconstruction_id: str) -> Path:
        """TUM file of the poses that a job was given; it may not exist."""
        return self.reconstruction(reconstruction_id) / "given-poses.tum"

    def given_calibration(self, reconstruction_id: str) -> Path:
        """Calibration that a job was given; it may not exist."""
        return self.reconstruction(reconstruction_id) / "given-calibration.npz"

    def upload(self, upload_id: str) -> Path:
        """Received bytes of an upload."""
        return self._uploads / f"{_checked(upload_id)}.part"

    def upload_row(self, upload_id: str) -> Path:
        """Copy of the catalogue's row of an upload."""
        return self._uploads / f"{_checked(upload_id)}.upload"

    def space(self) -> Space:
        """Space on the disk."""
        return space_at(self.path)

    def contents(self) -> tuple[set[str], set[str], set[str]]:
        """Ids of the captures, reconstructions and uploads that have files, whatever the catalogue says.

        Raises ConfigurationError.
        """
        try:
            return (
                {entry.name for entry in self._captures.iterdir() if is_id(entry.name)},
                {entry.name for entry in self._reconstructions.iterdir() if is_id(entry.name)},
                {entry.stem for entry in self._uploads.iterdir() if is_id(entry.stem)},
            )
        except OSError as error:
            message = f"{error.filename} cannot be read: {error.strerror}; let the user of the service read it"
            raise ConfigurationError(message) from error

    def set_aside(self, *paths: Path) -> Path:
        """Move files or folders to `lost+found`. Return the new place. Raises OSError."""
        target = self.path / "lost+found"
        target.mkdir(mode=0o700, exist_ok=True)
        for path in paths:
            names = (path.name, *(f"{path.name}.{number}" for number in range(2, 1000)))
            path.rename(next(target / name for name in names if not (target / name).exists()))
        return target

    def set_catalogue_aside(self, why: str) -> Path:
        """Rename the catalogue and its SQLite side files. Raises OSError."""
        aside = self.catalogue.with_name(f"{self.catalogue.name}.{why}-{datetime.now(UTC):%Y%m%dT%H%M%S.%fZ}")
        for suffix in ("", "-wal", "-shm"):
            part = self.path / (self.catalogue.name + suffix)
            if part.exists():
                part.rename(aside.with_name(aside.name + suffix))
        return aside

    def remove(self, folder: Path) -> None:
        """Delete the folder of a capture or reconstruction, if it exists."""
        # Renamed first, so that a kill in between never leaves half a capture under its name.
        removed = folder.with_name(f".{folder.name}{_REMOVED}")
        if folder.exists():
            folder.rename(removed)
        shutil.rmtree(removed, ignore_errors=True)

    def begin_purge(self, capture_id: str) -> None:
        """Rename the folder of a capture, which says that it was purged, until `end_purge`. Raises OSError."""
        removed = self._removed_capture(capture_id)
        if self.capture(capture_id).exists():
            shutil.rmtree(removed, ignore_errors=True)
            self.capture(capture_id).rename(removed)
        else:
            removed.mkdir(exist_ok=True)

    def undo_purge(self, capture_id: str) -> None:
        """Undo `begin_purge`. Raises OSError."""
        self._removed_capture(capture_id).rename(self.capture(capture_id))

    def purged(self) -> set[str]:
        """Ids of captures whose purge has begun and not ended; not of those that were put back from a backup."""
        found = {path.name[1 : -len(_REMOVED)] for path in self._captures.glob(f".*{_REMOVED}")}
        return {capture_id for capture_id in found if is_id(capture_id) and not self.capture(capture_id).exists()}

    def empty_purged(self, capture_id: str) -> None:
        """Delete the files of a purged capture, and keep its folder. Raises OSError."""
        for path in self._removed_capture(capture_id).iterdir():
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)

    def end_purge(self, capture_id: str) -> None:
        """Delete the folder of a purged capture, if it exists."""
        shutil.rmtree(self._removed_capture(capture_id), ignore_errors=True)

    def sweep(self) -> int:
        """Delete incomplete files of killed processes. Return their number. Folders of `purged` captures stay."""
        removed, purged = 0, {self._removed_capture(capture_id) for capture_id in self.purged()}
        for base in (self._captures, self._reconstructions):
            for leftover in base.glob(f".*{_REMOVED}"):
                if leftover not in purged:
                    shutil.rmtree(leftover, ignore_errors=True)
                    removed += 1
            for part in base.rglob("*.part"):
                part.unlink(missing_ok=True)
                removed += 1
        for converted in self._uploads.glob("*.dat"):
            converted.unlink(missing_ok=True)
            removed += 1
        return removed

    def close(self) -> None:
        """Unlock the folder."""
        self._lock.close()

    def _removed_capture(self, capture_id: str) -> Path:
        return self._captures / f".{_checked(capture_id)}{_REMOVED}"

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
