"""Poses of pictures: TUM files with their times, or nerfstudio's transforms.json with their names."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from spiked.distortion import Distortion, LensModel
from spiked.errors import SceneError
from spiked.sensor import Intrinsics
from spiked.simulate.pictures.reading import Pictures, natural
from spiked.trajectory import Trajectory

_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
"""From OpenGL's camera axes (y up, z back) to OpenCV's."""
_ORTHOGONAL = 1e-3
"""How far a rotation may be from an orthogonal matrix: files have some six digits."""


def read_poses(file: Path, pictures: Pictures, size: tuple[int, int]) -> tuple[Trajectory, Intrinsics | None]:
    """Camera-to-world poses on the clock of the pictures, and the optics of the pictures if the file states them.

    file: a TUM file, or a `transforms.json`, whose frames are those pictures that have their names; of a video they are
    all its pictures, in their order. size: width and height of the pictures. Raises SceneError.
    """
    if file.suffix.lower() != ".json":
        return Trajectory.read_tum(file), None
    try:
        content = _Transforms.model_validate_json(file.read_bytes())
    except OSError as error:
        raise SceneError(f"cannot read poses {file}: {error.strerror}") from error
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"])) or "the file"
        raise SceneError(f"{file}: {where}: {first['msg']}; expected nerfstudio's transforms.json") from error
    frames = content.frames
    if pictures.names:
        numbers = {Path(name).stem: number for number, name in enumerate(pictures.names)}
        found = {numbers[stem]: frame for frame in frames if (stem := Path(frame.file_path).stem) in numbers}
        if len(found) < 2:
            raise SceneError(
                f"{file} has poses of {len(found)} of the pictures in {pictures.path}; names must be equal"
            )
    elif len(frames) == len(pictures.times_s):
        found = dict(enumerate(sorted(frames, key=lambda frame: natural(frame.file_path))))
    else:
        raise SceneError(
            f"{file} has {len(frames)} poses and the video {len(pictures.times_s)} pictures; give a pose for each, "
            "or a TUM file with times"
        )
    order = sorted(found)
    matrices = np.stack([_matrix(found[number], file) for number in order])
    return Trajectory(pictures.times_s[order], matrices[:, :3, :3], matrices[:, :3, 3]), content.optics(file, size)


def _matrix(frame: "_Frame", file: Path) -> NDArray[np.float64]:
    matrix = np.array(frame.transform_matrix)
    rotation = matrix[:3, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > _ORTHOGONAL or np.linalg.det(rotation) < 0:
        raise SceneError(f"{file}: transform_matrix of {frame.file_path} is no rotation with a translation")
    return np.asarray(matrix @ _TO_OPENCV)


_Row = tuple[float, float, float, float]


class _Frame(BaseModel):
    model_config = ConfigDict(allow_inf_nan=False)

    file_path: str
    transform_matrix: tuple[_Row, _Row, _Row, _Row]


class _Transforms(BaseModel):
    model_config = ConfigDict(allow_inf_nan=False)

    frames: list[_Frame] = Field(min_length=2)
    camera_model: str = "OPENCV"
    camera_angle_x: float | None = Field(None, gt=0, lt=np.pi)
    fl_x: float | None = Field(None, gt=0)
    fl_y: float | None = Field(None, gt=0)
    cx: float | None = None
    cy: float | None = None
    w: float | None = Field(None, gt=0)
    h: float | None = Field(None, gt=0)
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    p1: float = 0.0
    p2: float = 0.0

    def optics(self, file: Path, size: tuple[int, int]) -> Intrinsics | None:
        """Of pictures of that size; None if there is no focal length. Raises SceneError."""
        width, height = self.w or size[0], self.h or size[1]
        fx = self.fl_x
        if fx is None and self.camera_angle_x is not None:
            fx = 0.5 * width / float(np.tan(0.5 * self.camera_angle_x))
        if fx is None:
            return None
        x, y = size[0] / width, size[1] / height
        cx, cy = (half if stated is None else stated for stated, half in ((self.cx, width / 2), (self.cy, height / 2)))
        return Intrinsics(fx * x, (self.fl_y or fx) * y, cx * x, cy * y, self._lens(file))

    def _lens(self, file: Path) -> Distortion | None:
        known: dict[str, Any] = {
            "OPENCV": (LensModel.OPENCV, (self.k1, self.k2, self.p1, self.p2, self.k3)),
            "PINHOLE": (LensModel.OPENCV, (0.0,) * 5),
            "OPENCV_FISHEYE": (LensModel.FISHEYE, (self.k1, self.k2, self.k3, self.k4)),
        }
        if self.camera_model not in known:
            raise SceneError(f"{file}: camera_model {self.camera_model} is not one of {', '.join(known)}")
        model, coefficients = known[self.camera_model]
        return Distortion(model, coefficients) if any(coefficients) else None
