"""The files of a job: what an attempt begins with, and its command with the paths of another machine."""

from collections.abc import Callable, Iterator
from pathlib import Path

from spiked.recon.checkpoint_file import CHECKPOINT, files_of
from spiked_service.cluster.messages import Inputs, StoredFile
from spiked_service.cluster.object_store import ObjectStore, stored_file
from spiked_service.store.folder import CAPTURE_ROW, RECONSTRUCTION_ROW
from spiked_service.workers.messages import JobCommand, MergeCommand

INPUTS = "inputs"
"""Folder of the objects that an attempt begins with, below its own."""
OUTPUTS = "outputs"
"""Folder of the objects that an attempt has made, below its own."""
MANIFEST = "manifest.json"
"""Written last below the folder of an attempt."""
LOG = "log"
"""The worker's log in the folder of a job."""
_OF_THE_SERVICE = frozenset({CAPTURE_ROW, RECONSTRUCTION_ROW, "thumbnail.webp"})
"""Files of the service, which no worker reads."""
_OF_A_VERSION = ("scene-", "trajectory-", "path-")
"""How names of files begin that belong to one version: they never change, and go with it."""


def recording_of(command: JobCommand) -> Path | None:
    """The recording that a job reads."""
    return None if isinstance(command, MergeCommand) else command.recording


def of_a_version(path: Path) -> bool:
    """Whether a file belongs to one version."""
    return path.name.startswith(_OF_A_VERSION)


def files_in(folder: Path, *, with_log: bool = False) -> Iterator[Path]:
    """Files of a job or a capture that belong to its results or its inputs: no checkpoint, nothing unfinished."""
    left_out = _OF_THE_SERVICE if with_log else _OF_THE_SERVICE | {LOG}
    for path in sorted(folder.rglob("*")):
        parts = path.relative_to(folder).parts
        hidden = any(part.startswith(".") for part in parts) or path.suffix == ".part"
        if path.is_file() and not hidden and parts[0] != CHECKPOINT and parts[0] not in left_out:
            yield path


def stage(command: JobCommand, store: ObjectStore, hold: Callable[[Path], list[StoredFile]]) -> Inputs:
    """Store what an attempt begins with, in its store; `hold` stores the folder of a recording.

    Raises ObjectStoreError and OSError.
    """
    recording = recording_of(command)
    in_place = store.local or recording is None
    found = []
    for path in [*files_in(command.folder), *files_of(command.folder / CHECKPOINT)]:
        stored = stored_file(path, path.relative_to(command.folder).as_posix())
        store.put_file(path, f"{INPUTS}/{stored.sha256}", stored)
        found.append(stored)
    return Inputs(
        recording=[] if in_place or recording is None else hold(recording.parent), folder=found, in_place=in_place
    )


def moved(command: JobCommand, folder: Path, recording_folder: Path | None) -> JobCommand:
    """The command with the folder of the job elsewhere, and that of the recording, too, unless it is None."""
    places = [(command.folder, folder)]
    recording = recording_of(command)
    if recording is not None and recording_folder is not None:
        places.append((recording.parent, recording_folder))

    def place(value: object) -> object:
        if isinstance(value, tuple):
            return tuple(place(one) for one in value)
        if isinstance(value, Path):
            for old, new in places:
                if value.is_relative_to(old):
                    return new / value.relative_to(old)
        return value

    fields = {name: place(getattr(command, name)) for name in type(command).model_fields}
    return command.model_copy(update=fields)
