"""Pictures with their times, one after the other: a folder of images, or a video. No more than one is in memory."""

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from spiked.errors import RecordingError
from spiked.natural_order import natural

Array = NDArray[np.float64]
Stored = NDArray[Any]
"""A picture as it is stored: uint8 or uint16, [H, W] or red, green and blue [H, W, 3]."""

SUFFIXES = frozenset({".bmp", ".jpeg", ".jpg", ".png", ".tif", ".tiff", ".webp"})
"""Images of 8 or 16 bits that OpenCV reads."""
TIME_FILES = ("times.txt", "times.csv", "timestamps.txt", "timestamps.csv", "rgb.txt")
"""Files of times in a folder of images, in the order in which they are looked for; the last is TUM RGB-D's."""
_ROUNDING_S = 1.1e-3
"""How far times may be from a constant rate that a video states: some containers round times to milliseconds."""
_DIGITS = ((18, 1e-9), (15, 1e-6), (12, 1e-3))
"""Unix times in names: digits from which on they are nanoseconds, microseconds or milliseconds, and the unit in s."""


class Pictures(Protocol):
    """Pictures in the order of their times."""

    @property
    def path(self) -> Path:
        """The video, or the folder."""
        ...

    @property
    def times_s(self) -> Array:
        """Increasing, [n], at least two."""
        ...

    @property
    def names(self) -> list[str]:
        """Of the files; of a video none."""
        ...

    def read(self) -> Iterator[Stored]:
        """The pictures from the first one on; all have the same size. Raises RecordingError."""
        ...


@dataclass(frozen=True)
class PictureFolder:
    """Images in a folder; see `Pictures`."""

    path: Path
    times_s: Array
    names: list[str]

    def read(self) -> Iterator[Stored]:
        """See `Pictures.read`."""
        shape = None
        for name in self.names:
            with _quiet():
                image = cv2.imread(str(self.path / name), cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR)
            if image is None:
                raise RecordingError(f"{self.path / name} is no image that can be read; remove it from the folder")
            if image.dtype not in (np.uint8, np.uint16):
                raise RecordingError(f"{self.path / name} has pixels of {image.dtype}; save it with 8 or 16 bits")
            if shape is not None and image.shape != shape:
                raise RecordingError(
                    f"{self.path / name} is {_size(image.shape)} and the pictures before it are {_size(shape)}; "
                    "bring all to one size"
                )
            shape = image.shape
            yield cv2.cvtColor(image, cv2.COLOR_BGR2RGB) if image.ndim == 3 else image


@dataclass(frozen=True)
class Video:
    """A video file that OpenCV decodes; see `Pictures`."""

    path: Path
    times_s: Array
    names: list[str]

    def read(self) -> Iterator[Stored]:
        """See `Pictures.read`."""
        video = _opened(self.path)
        try:
            for number in range(len(self.times_s)):
                found, image = video.read()
                if not found:
                    raise RecordingError(f"{self.path}: picture {number} cannot be decoded; repair or cut the video")
                yield cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
        finally:
            video.release()


def open_pictures(path: Path | str, rate_hz: float | None = None) -> Pictures:
    """A video, or a folder of images, with the times of the pictures in seconds.

    rate_hz: pictures a second, instead of the times that the video, a file of times or the names state.
    Times of a folder are those of a file in it (`TIME_FILES`; a line is a time in seconds, or a time and a name), else
    the names: seconds with a decimal point, or Unix times in milli-, micro- or nanoseconds. Raises RecordingError.
    """
    path = Path(path)
    if path.is_dir():
        return _open_folder(path, rate_hz)
    if not path.exists():
        raise RecordingError(f"there is no video or folder {path}")
    times = _video_times(path)
    if len(times) < 2:
        raise RecordingError(f"{path} has {_counted(len(times))}; spikes need the light between two at least")
    if rate_hz is not None:
        times = np.arange(len(times)) / rate_hz
    return Video(path, _increasing(times, path, [f"picture {number}" for number in range(len(times))]), [])


def _open_folder(folder: Path, rate_hz: float | None) -> PictureFolder:
    names = sorted((one.name for one in folder.iterdir() if one.suffix.lower() in SUFFIXES), key=natural)
    if len(names) < 2:
        raise RecordingError(
            f"{folder} has {_counted(len(names))} ({', '.join(sorted(SUFFIXES))}); spikes need the light between two "
            "at least"
        )
    if rate_hz is not None:
        return PictureFolder(folder, np.arange(len(names)) / rate_hz, names)
    file = next((folder / name for name in TIME_FILES if (folder / name).is_file()), None)
    if file is not None:
        times, names = _times_of_file(file, names)
    else:
        times = _times_of_names(folder, names)
        order = np.argsort(times, kind="stable")
        times, names = times[order], [names[k] for k in order]
    return PictureFolder(folder, _increasing(times, folder, names), names)


def _times_of_names(folder: Path, names: list[str]) -> Array:
    stems = [Path(name).stem for name in names]
    if all(re.fullmatch(r"\d+\.\d+", stem) for stem in stems):
        return np.array([float(stem) for stem in stems])
    digits = min(map(len, stems))
    unit = next((unit for least, unit in _DIGITS if digits >= least), None)
    if unit is None or not all(stem.isdecimal() for stem in stems):
        raise RecordingError(
            f"{folder}: the names, as {names[0]}, say no times; give --picture-rate, or a file {TIME_FILES[0]} with a "
            "time in seconds on each line"
        )
    first = min(map(int, stems))
    # Unix times in nanoseconds have more digits than a float.
    return unit * np.array([int(stem) - first for stem in stems], np.float64) + first * unit


def _times_of_file(file: Path, names: list[str]) -> tuple[Array, list[str]]:
    """Times and names, in the order of the file, or of the names where it has times only."""
    try:
        lines = file.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise RecordingError(f"{file} cannot be read as text: {error}") from error
    rows = [(number, re.split(r"[,;\s]+", line.strip())) for number, line in enumerate(lines, 1)]
    rows = [(number, row) for number, row in rows if row[0] and not row[0].startswith("#")]
    if rows and _number(rows[0][1][0]) is None and all(_number(cell) is None for cell in rows[0][1]):
        rows = rows[1:]  # names of columns
    times, found = [], []
    for number, row in rows:
        time = next((value for cell in row if (value := _number(cell)) is not None), None)
        if time is None:
            raise RecordingError(f"{file}, line {number}: expected a time in seconds, got {' '.join(row)[:80]!r}")
        times.append(time)
        named = [Path(cell).name for cell in row if _number(cell) is None]
        if named:
            if named[0] not in names:
                raise RecordingError(f"{file}, line {number}: there is no image {named[0]} in {file.parent}")
            found.append(named[0])
    if len(times) != (len(found) if found else len(names)):
        raise RecordingError(
            f"{file} has {len(times)} times and {len(found) or len(names)} names of images; give each image a time"
        )
    if len(times) < 2:
        raise RecordingError(f"{file} has {len(times)} times; spikes need the light between two pictures at least")
    return np.array(times), found or names


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if np.isfinite(value) else None


def _increasing(times: Array, place: Path, names: list[str]) -> Array:
    wrong = np.flatnonzero(np.diff(times) <= 0)
    if len(wrong):
        k = int(wrong[0])
        raise RecordingError(
            f"{place}: times do not increase: {names[k + 1]} at {times[k + 1]:.6f} s follows {names[k]} at "
            f"{times[k]:.6f} s; correct them, or give --picture-rate"
        )
    return times


def _video_times(path: Path) -> Array:
    """As the video states them; exact where they are those of its constant rate, rounded."""
    video = _opened(path)
    times = []
    try:
        while video.grab():
            times.append(1e-3 * video.get(cv2.CAP_PROP_POS_MSEC))
        rate = float(video.get(cv2.CAP_PROP_FPS))
    finally:
        video.release()
    if rate > 0 and times:
        even = times[0] + np.arange(len(times)) / rate
        if np.abs(np.array(times) - even).max() < _ROUNDING_S:
            return even
    return np.array(times)


def _opened(path: Path) -> cv2.VideoCapture:
    # FFmpeg's own lines; OpenCV reads the variable when it first decodes.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    with _quiet():
        video = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    if not video.isOpened():
        raise RecordingError(f"{path} is no video that OpenCV can decode; convert it, as with ffmpeg to .mp4")
    return video


@contextmanager
def _quiet() -> Iterator[None]:
    """OpenCV would print lines of its own beside the one of the error."""
    before = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(before)


def _counted(number: int) -> str:
    return ("no pictures", "one picture")[number] if number < 2 else f"{number} pictures"


def _size(shape: tuple[int, ...]) -> str:
    return f"{shape[1]}x{shape[0]} {'in colour' if len(shape) == 3 else 'grey'}"
