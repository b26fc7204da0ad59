"""A camera trajectory as poses at times, and the files that other tools read: TUM, KITTI, COLMAP, nerfstudio."""

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spiked.distortion import Distortion, LensModel
from spiked.errors import SceneError
from spiked.pose import Array, quaternion, rotation_of
from spiked.sensor import Sensor

__all__ = ["Trajectory", "colmap_camera", "colmap_lines", "kitti_lines", "nerfstudio_lines", "tum_lines", "tum_tables"]

BRIDGED_S = 0.03
"""Longest time between poses over which a path is interpolated, and to the nearest one: hand tremor has about 10 Hz."""
_LINES = 16_384
"""Lines of text in memory at a time."""


@dataclass(frozen=True)
class Trajectory:
    """`times_s` [n] increasing seconds, `rotations` [n, 3, 3] camera-to-world, `centres` [n, 3] in any length unit."""

    times_s: Array
    rotations: Array
    centres: Array

    @classmethod
    def empty(cls) -> "Trajectory":
        """Without poses."""
        return cls(np.zeros(0), np.zeros((0, 3, 3)), np.zeros((0, 3)))

    def __len__(self) -> int:
        return len(self.times_s)

    def matrices(self) -> Array:
        """Camera-to-world matrices [n, 4, 4]."""
        m = np.tile(np.eye(4), (len(self), 1, 1))
        m[:, :3, :3] = self.rotations
        m[:, :3, 3] = self.centres
        return m

    def between(self, begin_s: float, end_s: float) -> "Trajectory":
        """The poses with begin_s <= time < end_s."""
        keep = (self.times_s >= begin_s) & (self.times_s < end_s)
        return Trajectory(self.times_s[keep], self.rotations[keep], self.centres[keep])

    @classmethod
    def read_tum(cls, path: Path | str) -> "Trajectory":
        """Read `timestamp_s tx ty tz qx qy qz qw` lines; poses are sorted by time."""
        table = np.concatenate(list(tum_tables(Path(path))))
        if np.any(np.diff(table[:, 0]) < 0):
            table = table[np.argsort(table[:, 0], kind="stable")]
        return cls(table[:, 0], rotation_of(table[:, [7, 4, 5, 6]]), table[:, 1:4])

    def table(self) -> Array:
        """The rows [n, 8] of a TUM file: time, position, quaternion xyzw."""
        return np.column_stack([self.times_s, self.centres, quaternion(self.rotations)[:, [1, 2, 3, 0]]])

    def tum(self) -> str:
        """The text of a TUM file (quaternions xyzw)."""
        return "".join(tum_lines([self]))

    def kitti(self) -> str:
        """The text of a KITTI file: the upper three rows of each camera-to-world matrix; times are not kept."""
        return "".join(kitti_lines([self]))

    def colmap(self) -> str:
        """The text of COLMAP's `images.txt`: world-to-camera quaternion wxyz and translation, camera 1."""
        return "".join(colmap_lines([self]))

    def nerfstudio(self, sensor: Sensor) -> str:
        """The text of nerfstudio's `transforms.json`: camera-to-world with OpenGL axes (y up, z back)."""
        return "".join(nerfstudio_lines([self], sensor))

    def write_tum(self, path: Path | str, notes: Iterable[str] = ()) -> None:
        """Write a TUM file; `notes` become comments."""
        Path(path).write_text("".join(tum_lines([self], notes)), encoding="utf-8")

    def nearest(self, times_s: Array, within_s: float) -> NDArray[np.int64]:
        """For each time the index of the nearest pose, or -1 where none lies within `within_s`."""
        if len(self) == 0:
            return np.full(len(times_s), -1, np.int64)
        j = np.clip(np.searchsorted(self.times_s, times_s), 1, max(len(self) - 1, 1))
        before = np.abs(self.times_s[j - 1] - times_s) < np.abs(self.times_s[np.minimum(j, len(self) - 1)] - times_s)
        j = np.minimum(np.where(before, j - 1, j), len(self) - 1)
        return np.where(np.abs(self.times_s[j] - times_s) <= within_s, j, -1).astype(np.int64)


def tum_tables(path: Path) -> Iterator[Array]:
    """The rows [n, 8] of a TUM file, some ten thousand at a time, in their order. Raises SceneError."""
    first, found = 1, False
    try:
        with path.open(encoding="utf-8") as file:
            while lines := list(islice(file, _LINES)):
                rows = [line for line in lines if line.strip() and not line.lstrip().startswith("#")]
                if rows:
                    found = True
                    yield _table(rows, path, lines, first)
                first += len(lines)
    except (OSError, UnicodeDecodeError) as error:
        raise SceneError(f"cannot read trajectory {path}: {error}") from error
    if not found:
        raise SceneError(f"{path} holds no poses; expected lines 'timestamp_s tx ty tz qx qy qz qw'")


def _table(rows: list[str], path: Path, lines: list[str], first: int) -> Array:
    table = _parsed(rows)
    if table is None:
        number, line = next(
            (number, line)
            for number, line in enumerate(lines, first)
            if line.strip() and not line.lstrip().startswith("#") and _parsed([line]) is None
        )
        raise SceneError(
            f"{path}, line {number}: expected 'timestamp_s tx ty tz qx qy qz qw', got {line.strip()[:80]!r}"
        )
    return table


def _parsed(rows: list[str]) -> Array | None:
    """[n, 8], None if a row is none of a TUM file."""
    try:
        table = np.loadtxt(rows, comments=None, ndmin=2)
    except ValueError:
        return None
    sound = table.shape[1] == 8 and np.isfinite(table).all() and (np.linalg.norm(table[:, 4:], axis=1) > 1e-6).all()
    return table if sound else None


def tum_lines(parts: Iterable[Trajectory], notes: Iterable[str] = ()) -> Iterator[str]:
    """The text of a TUM file (quaternions xyzw), piece by piece; `notes` become comments."""
    yield from (f"# {note}\n" for note in notes)
    yield "# timestamp_s tx ty tz qx qy qz qw (camera to world, OpenCV axes, middle of each frame)\n"
    for part in parts:
        yield _written(" ".join(["%.9f"] * 8) + "\n", part.table())


def kitti_lines(parts: Iterable[Trajectory]) -> Iterator[str]:
    """The text of a KITTI file, piece by piece."""
    for part in parts:
        yield _written(" ".join(["%.9e"] * 12) + "\n", part.matrices()[:, :3].reshape(-1, 12))


def colmap_lines(parts: Iterable[Trajectory], notes: Iterable[str] = ()) -> Iterator[str]:
    """The text of COLMAP's `images.txt`, piece by piece; `notes` become comments."""
    yield from (f"# {note}\n" for note in notes)
    yield "# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, each followed by an empty line of points\n"
    first = 1
    for part in parts:
        inverse = part.rotations.swapaxes(-1, -2)
        t = -np.einsum("nij,nj->ni", inverse, part.centres)
        numbers = np.arange(first, first + len(part))
        first += len(part)
        line = "%d " + " ".join(["%.9f"] * 7) + " 1 %.9f.png\n\n"
        yield _written(line, numbers, quaternion(inverse), t, part.times_s)


def colmap_camera(sensor: Sensor) -> str:
    """The text of COLMAP's `cameras.txt`: PINHOLE, OPENCV, FULL_OPENCV if k3 is not 0, or OPENCV_FISHEYE.

    Raises SceneError without intrinsics.
    """
    if sensor.intrinsics is None:
        raise SceneError("a COLMAP model needs intrinsics; give --intrinsics or --fov")
    k = sensor.intrinsics
    model, coefficients = colmap_lens(k.distortion)
    numbers = [sensor.width, sensor.height, k.fx, k.fy, k.cx, k.cy, *coefficients.values()]
    names = " ".join(["# CAMERA_ID MODEL WIDTH HEIGHT FX FY CX CY", *(name.upper() for name in coefficients)])
    return f"{names}\n1 {model} {' '.join(map(repr, numbers))}\n"


def colmap_lens(lens: Distortion | None) -> tuple[str, dict[str, float]]:
    """COLMAP's name of a camera model, and its coefficients after the focal lengths and the centre."""
    if lens is None:
        return "PINHOLE", {}
    named = lens.named()
    if lens.model is LensModel.FISHEYE:
        return "OPENCV_FISHEYE", named
    k3 = named.pop("k3")
    if k3 == 0:
        return "OPENCV", named
    return "FULL_OPENCV", named | {"k3": k3, "k4": 0.0, "k5": 0.0, "k6": 0.0}


def nerfstudio_lines(
    parts: Iterable[Trajectory], sensor: Sensor, more: Mapping[str, Any] | None = None
) -> Iterator[str]:
    """The text of nerfstudio's `transforms.json`, piece by piece, with further fields.

    Raises SceneError without intrinsics.
    """
    if sensor.intrinsics is None:
        raise SceneError("nerfstudio's transforms.json needs intrinsics; give --intrinsics or --fov")
    k = sensor.intrinsics
    fisheye = k.distortion is not None and k.distortion.model is LensModel.FISHEYE
    camera = {"camera_model": "OPENCV_FISHEYE" if fisheye else "OPENCV", "w": sensor.width, "h": sensor.height}
    lens = {} if k.distortion is None else k.distortion.named()
    optics = {"fl_x": k.fx, "fl_y": k.fy, "cx": k.cx, "cy": k.cy, **lens}
    yield json.dumps({**camera, **optics, **(more or {})})[:-1] + ', "frames": ['
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    begin = "\n"
    for part in parts:
        frames = (
            json.dumps({"file_path": f"images/{t:.9f}.png", "transform_matrix": m.tolist()})
            for t, m in zip(part.times_s, part.matrices() @ flip, strict=True)
        )
        yield begin + ",\n".join(frames)
        begin = ",\n"
    yield "\n]}\n"


def _written(line: str, *columns: NDArray[Any]) -> str:
    """The columns [n, ...] in a format for one row: one formatting of all rows takes a third of the time of n."""
    table = np.column_stack(columns)
    return (line * len(table)) % tuple(table.ravel().tolist())
