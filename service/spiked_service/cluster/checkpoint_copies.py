"""Copies of a running worker's checkpoints in the store: another attempt goes on from the newest, on any machine.

A copy has a folder with its number below that of the attempt; a list of its files is written after them.
"""

import shutil
import time
from pathlib import Path

from pydantic import ValidationError

from spiked.errors import CheckpointError, SpikedError
from spiked.recon.checkpoint_file import CHECKPOINT, copy_newest, files_of
from spiked_service.cluster.background import Background
from spiked_service.cluster.messages import CheckpointCopy
from spiked_service.cluster.object_store import ObjectStore, stored_file

_PERIOD_S = 15.0
"""Seconds from one copy to the next, at least."""
_COST_SHARE = 0.05
"""Share of the time that copies may take before they become rarer."""
_FOLDER = "checkpoints"
"""Of the copies, below that of the attempt."""
_LIST = "checkpoint.json"
"""Says which copy is the newest."""


class CheckpointCopies(Background):
    """Stores copies while it is entered. One that cannot be stored is left out: the worker goes on."""

    def __init__(self, job: Path, part: Path, store: ObjectStore) -> None:
        """`job` is the folder of the job, `part` one for the copy that is being stored, `store` that of the attempt."""
        super().__init__("checkpoints")
        self._checkpoint = job / CHECKPOINT
        self._part = part
        self._store = store
        self._stored = CheckpointCopy(number=0, files=[])

    def last(self) -> CheckpointCopy | None:
        """The checkpoint of a worker that has ended, stored; None if there is none any more, as after its last step.

        Raises ObjectStoreError and OSError.
        """
        try:
            return self._stored if self._store_newest() else None
        except CheckpointError:
            return None  # it is damaged, as the next worker would find

    def _run(self) -> None:
        took_s = 0.0
        while not self._over.wait(max(_PERIOD_S, took_s / _COST_SHARE)):
            begun_s = time.monotonic()
            try:
                self._store_newest()
            except (SpikedError, OSError) as error:
                print(f"a checkpoint was not stored: {error}", flush=True)
            took_s = time.monotonic() - begun_s

    def _store_newest(self) -> bool:
        """Store the newest checkpoint if it has not been. Return whether there is one."""
        try:
            if not copy_newest(self._checkpoint, self._part):
                return False
            files = [stored_file(path, path.name) for path in files_of(self._part)]
            if files != self._stored.files:
                stored = CheckpointCopy(number=self._stored.number + 1, files=files)
                folder = _folder(self._store, stored)
                for one in files:
                    folder.put_file(self._part / one.name, one.sha256, one)
                self._store.put(_LIST, stored.model_dump_json().encode())
                _folder(self._store, self._stored).remove()
                self._stored = stored
            return True
        finally:
            shutil.rmtree(self._part, ignore_errors=True)


def newest_copy(store: ObjectStore) -> CheckpointCopy | None:
    """The newest copy of an attempt that has ended without a word. Raises ObjectStoreError."""
    content = store.get(_LIST)
    try:
        return None if content is None else CheckpointCopy.model_validate_json(content)
    except ValidationError:
        return None  # its agent died while it wrote the list


def fetch_copy(store: ObjectStore, copy: CheckpointCopy, job: Path) -> None:
    """Make a copy the checkpoint of a job, the state last. Raises ObjectStoreError and OSError."""
    folder, names = job / CHECKPOINT, {one.name for one in copy.files}
    for one in copy.files:
        _folder(store, copy).fetch(one.sha256, folder / one.name, one)
    for path in files_of(folder):
        if path.name not in names:
            path.unlink()


def _folder(store: ObjectStore, copy: CheckpointCopy) -> ObjectStore:
    return store.below(_FOLDER, f"{copy.number}")
