"""The folder of a running service, which goes when the service does, whatever ends it."""

import fcntl
import os
import shutil
import tempfile
from pathlib import Path

from spiked.errors import ConfigurationError
from spiked_service.base.ids import new_id

_LOCK = "lock"


class RuntimeFolder:
    """A folder `spiked-<user>/<id>` below the system's place for such things.

    The service holds a lock on a file in it; the kernel lets go of the lock when the service dies, so the next service
    knows which folders are nobody's, and removes them.
    """

    def __init__(self, base: Path | None = None) -> None:
        """Raises ConfigurationError where no folder can be made."""
        place = base or Path(os.environ.get("XDG_RUNTIME_DIR") or tempfile.gettempdir()) / f"spiked-{os.getuid()}"
        try:
            place.mkdir(mode=0o700, parents=True, exist_ok=True)
            if place.stat().st_uid != os.getuid():
                raise ConfigurationError(f"{place} belongs to another user; set XDG_RUNTIME_DIR or give --runtime")
            _remove_abandoned(place)
            self.path = place / new_id()
            self.path.mkdir()
        except OSError as error:
            raise ConfigurationError(f"cannot use {place} for running captures: {error.strerror}") from error
        self._lock = (self.path / _LOCK).open("w")
        fcntl.flock(self._lock, fcntl.LOCK_EX)

    def remove(self) -> None:
        """Remove the folder and all in it."""
        shutil.rmtree(self.path)
        self._lock.close()


def _remove_abandoned(place: Path) -> None:
    for folder in place.iterdir():
        lock = folder / _LOCK
        if not lock.exists():
            continue  # another service is just making it
        with lock.open("w") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                continue
        shutil.rmtree(folder)
