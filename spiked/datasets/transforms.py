"""Pictures with `transforms.json`: the layout of nerfstudio and instant-ngp, and of Blender's synthetic scenes."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from spiked.datasets.clip import PictureScene
from spiked.datasets.kind import DatasetKind
from spiked.datasets.pictures import make_scene, picture_size
from spiked.datasets.spikes import PICTURE_SUFFIXES, inside, natural
from spiked.distortion import Distortion, LensModel
from spiked.errors import ConfigurationError, DatasetError, SceneError
from spiked.sensor import Intrinsics

FILE = "transforms.json"
_SPLITS = ("transforms_train.json", "transforms_val.json", "transforms_test.json")
"""Of Blender's scenes; together they are one scene."""
_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
"""From OpenGL's camera axes (y up, z back) to OpenCV's (y down, z forward)."""
_ROTATION_TOLERANCE = 1e-3
"""How far a rotation may be from an orthogonal matrix: files have six digits."""


class _Frame(BaseModel):
    model_config = ConfigDict(extra="ignore", allow_inf_nan=False)

    file_path: str
    transform_matrix: list[list[float]]
    time: float | None = None


class _Camera(BaseModel):
    model_config = ConfigDict(extra="ignore", allow_inf_nan=False)

    camera_model: str | None = None
    camera_angle_x: float | None = Field(default=None, gt=0, lt=np.pi)
    fl_x: float | None = Field(default=None, gt=0)
    fl_y: float | None = Field(default=None, gt=0)
    cx: float | None = None
    cy: float | None = None
    w: int | None = Field(default=None, gt=0)
    h: int | None = Field(default=None, gt=0)
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    p1: float = 0.0
    p2: float = 0.0


class Transforms(_Camera):
    """The content of a `transforms.json`; what is not needed is left out."""

    frames: list[_Frame] = Field(min_length=1)

    @classmethod
    def read(cls, path: Path) -> "Transforms":
        """Raises SceneError with the field that is wrong."""
        try:
            return cls.model_validate(json.loads(path.read_text("utf-8")))
        except (OSError, UnicodeDecodeError, json.JSONDecodeError, RecursionError) as error:
            raise SceneError(f"{path}: this is no readable JSON: {error}") from error
        except ValidationError as error:
            problem: Any = error.errors(include_url=False)[0]
            field = ".".join(str(part) for part in problem["loc"])
            raise SceneError(f"{path}: field {field!r}: {problem['msg']}; correct the file") from error

    def poses(self, path: Path) -> np.ndarray[Any, np.dtype[np.float64]]:
        """Camera to world with OpenCV axes, float64 [n, 4, 4]. Raises SceneError."""
        try:
            matrices = np.array([frame.transform_matrix for frame in self.frames], np.float64)
        except ValueError as error:
            raise SceneError(f"{path}: the matrices are not all of one size; they are 4x4") from error
        if matrices.shape[1:] not in ((4, 4), (3, 4)):
            raise SceneError(f"{path}: a transform_matrix is {matrices.shape[1:]} and not 4x4")
        if matrices.shape[1] == 3:
            matrices = np.concatenate([matrices, np.tile([[[0.0, 0.0, 0.0, 1.0]]], (len(matrices), 1, 1))], 1)
        rotations = matrices[:, :3, :3]
        off = np.abs(rotations @ rotations.swapaxes(-1, -2) - np.eye(3)).max((1, 2))
        wrong = np.flatnonzero((off > _ROTATION_TOLERANCE) | (np.linalg.det(rotations) < 0))
        if len(wrong):
            name = self.frames[wrong[0]].file_path
            raise SceneError(f"{path}: the matrix of {name} is no rotation with a translation; correct it")
        return np.asarray(matrices @ _TO_OPENCV)

    def camera(self, path: Path, first: Path) -> tuple[int, int, Intrinsics]:
        """Width, height and intrinsics; sizes that are not stated are those of the first picture. Raises SceneError."""
        width, height = (self.w, self.h) if self.w and self.h else picture_size(first)
        if self.fl_x is not None:
            fx = self.fl_x
        elif self.camera_angle_x is not None:
            fx = 0.5 * width / float(np.tan(self.camera_angle_x / 2))
        else:
            raise SceneError(f"{path}: neither fl_x nor camera_angle_x is stated: the focal length is unknown")
        cx, cy = (width / 2 if self.cx is None else self.cx), (height / 2 if self.cy is None else self.cy)
        try:
            lens = self._lens()
        except ConfigurationError as error:
            raise SceneError(f"{path}: {error}") from error
        return width, height, Intrinsics(fx, self.fl_y or fx, cx, cy, lens)

    def _lens(self) -> Distortion | None:
        if self.camera_model in ("OPENCV_FISHEYE", "FISHEYE"):
            lens = Distortion(LensModel.FISHEYE, (self.k1, self.k2, self.k3, self.k4))
        elif self.camera_model in (None, "OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE"):
            if self.k4:
                raise ConfigurationError("k4 of OpenCV's model is not supported: undistort the pictures")
            lens = Distortion(LensModel.OPENCV, (self.k1, self.k2, self.p1, self.p2, self.k3))
        else:
            raise ConfigurationError(f"cameras of the model {self.camera_model} are not supported")
        return lens if any(lens.coefficients) else None


def scenes_in(folder: Path) -> Iterator[Path]:
    """Folders with such a file: the folder itself, or those in it."""
    if _files(folder):
        yield folder
        return
    yield from (child for child in sorted(folder.iterdir()) if child.is_dir() and _files(child))


def recognises(folder: Path) -> bool:
    """Whether there is a scene without clips of spikes beside it."""
    return any(not (scene / "spike_data").is_dir() for scene in scenes_in(folder))


def read_scene(name: str, scene: Path) -> PictureScene:
    """A scene of `transforms.json`, or of the files of a split. Raises SceneError and DatasetError."""
    pictures: list[Path] = []
    matrices, times = [], []
    camera = None
    for path in _files(scene):
        content = Transforms.read(path)
        found = [_picture(scene, frame.file_path) for frame in content.frames]
        matrices.append(content.poses(path))
        times += [frame.time for frame in content.frames]
        own = content.camera(path, found[0])
        if camera is not None and own != camera:
            raise DatasetError(f"{path}: its camera is another one than that of the files before; separate the scenes")
        camera = own
        pictures += found
    if camera is None:
        raise DatasetError(f"{scene} has no {FILE}")
    poses = np.concatenate(matrices)
    stated = None if None in times else np.array(times, np.float64)
    if stated is not None and len(np.unique(stated)) < len(stated):
        stated = None  # times of Blender's scenes are all 0
    made = make_scene(name, pictures, poses[:, :3, :3], poses[:, :3, 3], camera, times_s=stated)
    return replace(made, described_by=tuple(_files(scene)))


def read(folder: Path) -> tuple[PictureScene, ...]:
    """All scenes of a folder. Raises SceneError and DatasetError."""
    return tuple(read_scene(scene.name or "scene", scene) for scene in sorted(scenes_in(folder), key=natural))


def _files(scene: Path) -> list[Path]:
    if (scene / FILE).is_file():
        return [scene / FILE]
    return [scene / name for name in _SPLITS if (scene / name).is_file()]


def _picture(scene: Path, name: str) -> Path:
    """The file of a picture, whose name in Blender's scenes has no ending. Raises DatasetError."""
    path = inside(scene, name)
    if path.suffix.lower() in PICTURE_SUFFIXES:
        return path
    return next((found for end in PICTURE_SUFFIXES if (found := Path(f"{path}{end}")).is_file()), path)


KIND = DatasetKind(
    name="transforms",
    title="Pictures with transforms.json (nerfstudio, instant-ngp, Blender)",
    sensor="pictures of any camera; spikes are made of them",
    licence="that of the pictures",
    size="any",
    published="https://docs.nerf.studio/quickstart/data_conventions.html (the format)",
    get="make it of your own pictures: ns-process-data images --data PICTURES --output-dir SCENE",
    citation="M. Tancik et al., Nerfstudio: A Modular Framework for Neural Radiance Field Development, SIGGRAPH 2023",
    layout="""
SCENE/transforms.json, or transforms_train.json, transforms_val.json, transforms_test.json
SCENE/images/*.png or wherever file_path says
SCENE may be the folder itself, or each of its folders
""",
    certainty="documented by nerfstudio",
    recognises=recognises,
    read=read,
)
