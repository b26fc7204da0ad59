"""The results in the folder of a job on the service's machine, which become those of an attempt."""

from collections.abc import Sequence
from pathlib import Path

from spiked_service.cluster.attempt_log import AttemptLog
from spiked_service.cluster.job_files import LOG, OUTPUTS, files_in, of_a_version
from spiked_service.cluster.messages import StoredFile
from spiked_service.cluster.object_store import ObjectStore, sha256_of
from spiked_service.results.versions import INDEX, forget_with


class JobFolder:
    """Knows what is in the folder, by hashes. For one thread; nobody else writes there meanwhile."""

    def __init__(self, folder: Path, log: AttemptLog) -> None:
        self.path = folder
        self._log = log
        self._known: dict[str, str] | None = None
        """Hashes of the files, by name; None before the first fetch."""

    def fetch(self, files: Sequence[StoredFile], store: ObjectStore) -> None:
        """Bring it to what the attempt of this store has, the index of the versions last.

        Another agent of the attempt may have made other versions with the same names. Whatever ends this in the middle,
        the index lists only what is there. Raises ObjectStoreError and OSError.
        """
        if self._known is None:
            self._known = {path.relative_to(self.path).as_posix(): sha256_of(path) for path in files_in(self.path)}
        have, wanted = self._known, {stored.name: stored.sha256 for stored in files}
        versioned = {path.relative_to(self.path).as_posix() for path in files_in(self.path) if of_a_version(path)}
        other = {name for name in versioned if wanted.get(name) != have.get(name)}
        if forget_with(self.path, other):
            have.pop(INDEX, None)
        for stored in sorted(files, key=lambda one: one.name == INDEX):
            if have.get(stored.name) != stored.sha256:
                path = self._log.arriving if stored.name == LOG else self.path / stored.name
                store.fetch(f"{OUTPUTS}/{stored.sha256}", path, stored)
                have[stored.name] = stored.sha256
                if stored.name == LOG:
                    self._log.take()
        for name in other - wanted.keys():
            (self.path / name).unlink(missing_ok=True)
            have.pop(name, None)
