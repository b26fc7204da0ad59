"""Cameras, poses and points of a COLMAP model: `cameras`, `images` and `points3D`, as `.bin` or as `.txt`.

The format is that of COLMAP's documentation ("Output Format"): little-endian; poses are world to camera, a quaternion
wxyz and a translation; the centre of the first pixel is (0.5, 0.5), as here.
"""

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from spiked.distortion import Distortion, LensModel
from spiked.errors import ConfigurationError, SceneError
from spiked.pose import rotation_of
from spiked.sensor import Intrinsics

Array = NDArray[np.float64]

MODELS = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
}
"""Name and number of parameters of each camera model, by its number in a binary file."""
POINT_2D_BYTES, TRACK_BYTES = 24, 8
"""Bytes of an observation in `images.bin`, and of an element of a track in `points3D.bin`."""
MOST_NAME = 4096
"""Bytes of a picture's name, at most."""
DEPTH_POINTS, DEPTH_VIEWS = 5000, 16
"""Points and views of which the median depth is taken, at most, evenly chosen."""


@dataclass(frozen=True)
class ColmapCamera:
    """A camera of a model."""

    width: int
    height: int
    intrinsics: Intrinsics


@dataclass(frozen=True)
class ColmapModel:
    """The pictures of a model in the order of its file."""

    names: tuple[str, ...]
    cameras: tuple[ColmapCamera, ...]
    """Of each picture."""
    rotations: Array
    """Camera to world, [n, 3, 3]."""
    centres: Array
    """[n, 3]."""
    points: Array
    """[m, 3]; m is 0 without a file of points."""

    def median_depth(self) -> float | None:
        """Of points in front of some of the cameras; None without points."""
        if not len(self.points):
            return None
        points = self.points[:: max(1, len(self.points) // DEPTH_POINTS)]
        views = slice(None, None, max(1, len(self.names) // DEPTH_VIEWS))
        axes, centres = self.rotations[views, :, 2], self.centres[views]
        depth = ((points[None] - centres[:, None]) * axes[:, None]).sum(-1)
        front = depth[depth > 0]
        return float(np.median(front)) if front.size else None


def find_model(scene: Path) -> Path | None:
    """The folder of the model of a scene: `sparse/0`, `sparse`, `colmap/sparse/0` or the folder itself."""
    for folder in (scene / "sparse" / "0", scene / "sparse", scene / "colmap" / "sparse" / "0", scene):
        if any((folder / f"images{end}").is_file() for end in (".bin", ".txt")):
            return folder
    return None


def read_model(folder: Path) -> ColmapModel:
    """Read the model in a folder, binary files first. Raises SceneError."""
    binary = (folder / "images.bin").is_file()
    end = ".bin" if binary else ".txt"
    cameras_file, images_file, points_file = (folder / f"{part}{end}" for part in ("cameras", "images", "points3D"))
    if not cameras_file.is_file():
        raise SceneError(f"{cameras_file}: this file is missing beside {images_file.name}; copy the whole model")
    cameras = _cameras_bin(cameras_file) if binary else _cameras_txt(cameras_file)
    ids, names, quaternions, translations = _images_bin(images_file) if binary else _images_txt(images_file)
    if not names:
        raise SceneError(f"{images_file}: the model has no picture")
    missing = sorted(set(ids) - cameras.keys())
    if missing:
        raise SceneError(f"{images_file}: its pictures are of camera {missing[0]}, which {cameras_file.name} has not")
    norms = np.linalg.norm(quaternions, axis=1)
    if not (np.isfinite(quaternions).all() and np.isfinite(translations).all() and (norms > 1e-6).all()):
        raise SceneError(f"{images_file}: a pose is not finite, or its quaternion is 0: the file is damaged")
    rotations = rotation_of(quaternions / norms[:, None]).swapaxes(-1, -2)
    centres = -np.einsum("nij,nj->ni", rotations, translations)
    points = np.empty((0, 3))
    if points_file.is_file():
        points = _points_bin(points_file) if binary else _points_txt(points_file)
    return ColmapModel(names, tuple(cameras[i] for i in ids), rotations, centres, points)


class _Bytes:
    """A binary file, read from its beginning. Raises SceneError where it ends too early."""

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            self._data = path.read_bytes()
        except OSError as error:
            raise SceneError(f"{path}: cannot be read: {error.strerror}") from error
        self._at = 0

    def take(self, form: str) -> tuple[int | float, ...]:
        size = struct.calcsize(form)
        self._need(size)
        values = struct.unpack_from(form, self._data, self._at)
        self._at += size
        return values

    def count(self, least_bytes: int) -> int:
        """A number of records, each of at least so many bytes."""
        (count,) = self.take("<Q")
        self._need(int(count) * least_bytes)
        return int(count)

    def skip(self, size: int) -> None:
        self._need(size)
        self._at += size

    def name(self) -> str:
        end = self._data.find(b"\0", self._at, self._at + MOST_NAME)
        if end < 0:
            raise SceneError(f"{self._path}: a picture's name has no end within {MOST_NAME} bytes: it is damaged")
        name = self._data[self._at : end].decode(errors="replace")
        self._at = end + 1
        return name

    def _need(self, size: int) -> None:
        if self._at + size > len(self._data):
            raise SceneError(
                f"{self._path}: it ends after {len(self._data)} bytes, within a record that needs "
                f"{self._at + size}: the file is cut or damaged; copy it anew"
            )


def _cameras_bin(path: Path) -> dict[int, ColmapCamera]:
    file = _Bytes(path)
    cameras = {}
    for _ in range(file.count(24 + 8 * 3)):
        camera, model, width, height = (int(value) for value in file.take("<iiQQ"))
        if model not in MODELS:
            raise SceneError(f"{path}: camera {camera} has the model {model}, which COLMAP does not document")
        name, count = MODELS[model]
        parameters = [float(value) for value in file.take(f"<{count}d")]
        cameras[camera] = _camera(path, name, width, height, parameters)
    return cameras


def _images_bin(path: Path) -> tuple[list[int], tuple[str, ...], Array, Array]:
    file = _Bytes(path)
    ids, names, poses = [], [], []
    for _ in range(file.count(64 + 1 + 8)):
        _, *pose, camera = file.take("<I7dI")
        names.append(file.name())
        file.skip(POINT_2D_BYTES * file.count(POINT_2D_BYTES))
        ids.append(int(camera))
        poses.append(pose)
    table = np.array(poses, np.float64).reshape(-1, 7)
    return ids, tuple(names), table[:, :4], table[:, 4:]


def _points_bin(path: Path) -> Array:
    file = _Bytes(path)
    points = []
    for _ in range(file.count(43 + 8)):
        _, x, y, z, *_ = file.take("<Q3d3Bd")
        points.append((x, y, z))
        file.skip(TRACK_BYTES * file.count(TRACK_BYTES))
    return np.array(points, np.float64).reshape(-1, 3)


def _lines(path: Path) -> list[tuple[int, str]]:
    """Lines with their numbers, without comments."""
    try:
        text = path.read_text("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise SceneError(f"{path}: cannot be read: {error}") from error
    return [(n, line) for n, line in enumerate(text.splitlines(), 1) if not line.lstrip().startswith("#")]


def _cameras_txt(path: Path) -> dict[int, ColmapCamera]:
    cameras = {}
    for number, line in _lines(path):
        words = line.split()
        if not words:
            continue
        try:
            camera, name, width, height = int(words[0]), words[1], int(words[2]), int(words[3])
            parameters = [float(word) for word in words[4:]]
        except (ValueError, IndexError) as error:
            raise SceneError(f"{path}, line {number}: expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS") from error
        cameras[camera] = _camera(path, name, width, height, parameters)
    return cameras


def _images_txt(path: Path) -> tuple[list[int], tuple[str, ...], Array, Array]:
    ids, names, poses = [], [], []
    lines = _lines(path)
    while lines and not lines[0][1].strip():
        lines = lines[1:]
    for number, line in lines[::2]:  # every other line is of observations, and may be empty
        if not line.strip():
            continue
        words = line.split(maxsplit=9)
        try:
            poses.append([float(word) for word in words[1:8]])
            ids.append(int(words[8]))
            names.append(words[9].strip())
        except (ValueError, IndexError) as error:
            raise SceneError(
                f"{path}, line {number}: expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, and each such line "
                "followed by one of observations"
            ) from error
    table = np.array(poses, np.float64).reshape(-1, 7)
    return ids, tuple(names), table[:, :4], table[:, 4:]


def _points_txt(path: Path) -> Array:
    rows = [line.split()[1:4] for _, line in _lines(path) if line.strip()]
    try:
        return np.array(rows, np.float64).reshape(-1, 3)
    except ValueError as error:
        raise SceneError(f"{path}: a line does not begin with POINT3D_ID X Y Z: {error}") from error


def _camera(path: Path, model: str, width: int, height: int, parameters: list[float]) -> ColmapCamera:
    counts = dict(MODELS.values())
    if counts.get(model) != len(parameters):
        raise SceneError(f"{path}: a camera of the model {model} with {len(parameters)} parameters is not COLMAP's")
    if min(width, height) < 1 or not np.isfinite(parameters).all():
        raise SceneError(f"{path}: a camera of {width}x{height} pixels with parameters {parameters}: it is damaged")
    try:
        return ColmapCamera(width, height, intrinsics_of(model, parameters))
    except ConfigurationError as error:
        raise SceneError(f"{path}: {error}") from error


def intrinsics_of(model: str, p: list[float]) -> Intrinsics:
    """Intrinsics of the parameters of a COLMAP camera model. Raises ConfigurationError for lenses not known here."""
    opencv, fisheye = LensModel.OPENCV, LensModel.FISHEYE
    lens: Distortion | None = None
    shared = model.startswith(("SIMPLE", "RADIAL"))
    fx, fy, cx, cy = (p[0], p[0], p[1], p[2]) if shared else (p[0], p[1], p[2], p[3])
    match model:
        case "SIMPLE_PINHOLE" | "PINHOLE":
            pass
        case "SIMPLE_RADIAL" | "RADIAL":
            lens = Distortion(opencv, tuple(p[3:]))
        case "SIMPLE_RADIAL_FISHEYE" | "RADIAL_FISHEYE":
            lens = Distortion(fisheye, tuple(p[3:]))
        case "OPENCV":
            lens = Distortion(opencv, tuple(p[4:]))
        case "OPENCV_FISHEYE":
            lens = Distortion(fisheye, tuple(p[4:]))
        case "FULL_OPENCV" if not any(p[9:]):
            lens = Distortion(opencv, tuple(p[4:9]))
        case _:
            raise ConfigurationError(
                f"cameras of the model {model} are not supported: undistort the pictures (colmap image_undistorter)"
            )
    if min(fx, fy) <= 0:
        raise ConfigurationError(f"a focal length of {min(fx, fy):g} pixels is impossible")
    return Intrinsics(fx, fy, cx, cy, lens if lens is not None and any(lens.coefficients) else None)
