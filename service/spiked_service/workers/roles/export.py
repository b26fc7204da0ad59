"""The export worker: writes a published version in the format of another program."""

import os
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from spiked.errors import SceneError
from spiked.export import ExportSource, find_kind
from spiked.frame_of_reference import FrameOfReference
from spiked.poses import PoseFile
from spiked.recording import open_recording
from spiked.scene import Scene
from spiked.whole_files import FULL, whole_file
from spiked_service.store.disk_space import DiskFullError
from spiked_service.workers.channel import WorkerChannel
from spiked_service.workers.messages import ExportCommand

NICE = 10
"""Niceness: live captures have priority."""


def run_export(command: ExportCommand, channel: WorkerChannel) -> None:
    """Write the file whole or not at all. Raises DiskFullError, and SpikedError for what the user can correct."""
    os.nice(NICE)
    kind, source = find_kind(command.kind), source_of(command)
    with disk_told(), whole_file(command.out) as part:
        if kind.folder:
            with TemporaryDirectory(dir=part.parent, prefix=".export-") as name:
                folder = Path(name) / command.name
                kind.write(source, folder, command.options)
                _zip(folder, part)
        else:
            kind.fill(source, part, command.options)


@contextmanager
def disk_told() -> Iterator[None]:
    """Around the writing of a file that somebody has asked for: raises DiskFullError and SceneError for OSError."""
    try:
        yield
    except OSError as error:
        why = f"the file cannot be written: {error.strerror or error}"
        if error.errno in FULL:
            raise DiskFullError(f"{why}; free disk space in the data folder, or remove and purge captures") from error
        raise SceneError(f"{why}; see the state of the disk of the data folder") from error


def source_of(command: ExportCommand) -> ExportSource:
    """The version. Raises SceneError and RecordingError."""
    poses = PoseFile(command.poses)
    recording = None if command.recording is None else open_recording(command.recording)
    source = ExportSource(
        path=poses.trajectory(range(len(poses))),
        sensor=command.sensor,
        scene=replace(Scene.read_ply(command.scene), white=command.white),
        recording=recording,
        first_frame=command.first_frame,
        name=command.name,
        title=command.title,
        scale=command.scale,
    )
    if not command.metric:
        return source
    assert command.scale.metres_per_unit is not None, "the scale of a metric export is known"
    return source.in_frame(FrameOfReference(command.scale.metres_per_unit, command.scale.up))


def _zip(folder: Path, out: Path) -> None:
    """All files of a folder, below its name; pictures are compressed already."""
    with zipfile.ZipFile(out, "w", zipfile.ZIP_STORED) as archive:
        for file in sorted(folder.rglob("*")):
            archive.write(file, file.relative_to(folder.parent))
