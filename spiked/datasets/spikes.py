"""Clips of the containers that several data sets share: `.dat` recordings, arrays, and runs of such files."""

import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from spiked.datasets.clip import Clip, Truth
from spiked.errors import DatasetError, RecordingError
from spiked.natural_order import natural
from spiked.recording import Recording, RecordingGeometry, open_recording
from spiked.recording.arrays import open_array
from spiked.recording.geometry import Assumable
from spiked.sensor import Response, Sensor
from spiked.trajectory import Trajectory

CHUNK_FRAMES = 64
"""Frames read at a time."""
PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
"""Names of pictures end so, in lower case."""


def files_in(folder: Path, *suffixes: str, deep: bool = False) -> list[Path]:
    """Files whose names end so, in natural order; with `deep` those of folders within, too."""
    found = folder.rglob("*") if deep else folder.glob("*")
    return sorted((path for path in found if path.suffix.lower() in suffixes and path.is_file()), key=natural)


def name_of(folder: Path, path: Path) -> str:
    """The name of a clip: its path in the data set without the ending."""
    return path.relative_to(folder).with_suffix("").as_posix()


def truth_beside(path: Path) -> Truth:
    """The truth of `NAME.tum`, or of `groundtruth.tum` in the folder of the only recording. Raises SceneError."""
    own, common = path.with_suffix(".tum"), path.parent / "groundtruth.tum"
    if own.is_file():
        return Truth(Trajectory.read_tum(own))
    if common.is_file() and len(files_in(path.parent, path.suffix.lower())) == 1:
        return Truth(Trajectory.read_tum(common))
    return Truth()


def recorded_clip(folder: Path, path: Path, given: RecordingGeometry, truth: Truth | None = None) -> Clip:
    """A `.dat` file that is a recording as it is. Raises RecordingError."""
    recording = open_recording(path, **given.stated())
    return Clip(
        name_of(folder, path),
        (path,),
        recording.sensor,
        recording.frames,
        lambda: recorded_blocks(recording, 0, recording.frames),
        is_recording=True,
        assumed=recording.assumed,
        notes=recording.warnings,
        truth=truth_beside(path) if truth is None else truth,
    )


def recorded_blocks(recording: Recording, first: int, stop: int) -> Iterator[NDArray[np.uint8]]:
    """Frames `first` to `stop - 1` of a recording as blocks of a `Clip`, uint8 [n, frame_bytes]."""
    for begin in range(first, stop, CHUNK_FRAMES):
        yield recording.compact(begin, min(CHUNK_FRAMES, stop - begin))


def array_clip(
    folder: Path,
    path: Path,
    rate_hz: float,
    *,
    array: str | None = None,
    width: int | None = None,
    response: Response = Response.INTEGRATE_AND_FIRE,
    assumed: tuple[Assumable, ...] = ("frame_rate", "flipped"),
) -> Clip:
    """An array of 0 and 1 or of packed bits, rows top-down. Raises RecordingError."""
    found = open_array(path, array, width)
    notes: tuple[str, ...] = ()
    if found.width < found.columns:
        notes = (f"{found.columns - found.width} of {found.columns} columns at the right are left out",)
    sensor = Sensor(found.width, found.height, rate_hz, flipped=False, response=response)
    return Clip(
        name_of(folder, path),
        (path,),
        sensor,
        found.frames,
        found.blocks,
        assumed=assumed,
        notes=notes,
        truth=truth_beside(path),
    )


def same_sensor(folder: Path, recordings: list[Recording]) -> Sensor:
    """The sensor of all of them. Raises DatasetError where two differ."""
    first = recordings[0]
    for other in recordings[1:]:
        if replace(other.sensor, intrinsics=None) != replace(first.sensor, intrinsics=None):
            raise DatasetError(
                f"{folder}: {other.path.name} is of {other.sensor.width}x{other.sensor.height}, {first.path.name} of "
                f"{first.sensor.width}x{first.sensor.height}: clips of two cameras are mixed; separate them"
            )
    return first.sensor


def whole_frames(path: Path, given: RecordingGeometry, frames: int | None = None) -> Recording:
    """A recording whose size is a whole number of frames, `frames` if stated. Raises DatasetError."""
    recording = open_recording(path, **given.stated())
    if recording.trailing_bytes:
        raise DatasetError(
            f"{path}: {path.stat().st_size} bytes are {recording.frames} frames of {recording.sensor.width}x"
            f"{recording.sensor.height} and {recording.trailing_bytes} bytes more: the file is cut or of another size"
        )
    if frames is not None and recording.frames != frames:
        raise DatasetError(
            f"{path}: it has {recording.frames} frames and not {frames}: copy it anew from where the authors publish it"
        )
    return recording


def checked_picture(path: Path) -> Path:
    """The path of a picture that is there. Raises DatasetError."""
    if not path.is_file():
        raise DatasetError(f"{path}: this picture is missing; copy the folder anew")
    return path


def inside(folder: Path, name: str) -> Path:
    """The path of a file that a data set names. Raises DatasetError where it lies outside of the folder."""
    path = Path(os.path.normpath(folder / name))
    if not path.is_relative_to(os.path.normpath(folder)):
        raise DatasetError(f"{folder}: the file {name!r} is outside of this folder; correct what names it")
    return path


def unreadable(path: Path, error: Exception) -> RecordingError:
    """The error of a file that cannot be read."""
    return RecordingError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}; copy it anew")
