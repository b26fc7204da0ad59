"""`transforms.json` of nerfstudio, instant-ngp and Blender's synthetic scenes: poses and optics of pictures."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from spiked.distortion import Distortion, LensModel
from spiked.errors import ConfigurationError, SceneError
from spiked.sensor import Intrinsics

__all__ = ["PosedPicture", "Transforms"]

_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
"""From OpenGL's camera axes (y up, z back) to OpenCV's (y down, z forward)."""
_ROTATION_TOLERANCE = 1e-3
"""How far a rotation may be from an orthogonal matrix: files have six digits."""


class PosedPicture(BaseModel):
    """An entry of `frames`."""

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

    frames: list[PosedPicture] = Field(min_length=1)

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

    def poses(self, path: Path) -> NDArray[np.float64]:
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

    def intrinsics(self, path: Path, size: tuple[int, int]) -> Intrinsics | None:
        """Of pictures of that width and height; None if no focal length is stated. Raises SceneError.

        What is stated for pictures of another size is scaled to this one.
        """
        width, height = self.w or size[0], self.h or size[1]
        fx = self.fl_x
        if fx is None and self.camera_angle_x is not None:
            fx = 0.5 * width / float(np.tan(self.camera_angle_x / 2))
        if fx is None:
            return None
        cx, cy = (width / 2 if self.cx is None else self.cx), (height / 2 if self.cy is None else self.cy)
        try:
            lens = self._lens()
        except ConfigurationError as error:
            raise SceneError(f"{path}: {error}") from error
        x, y = size[0] / width, size[1] / height
        return Intrinsics(fx * x, (self.fl_y or fx) * y, cx * x, cy * y, lens)

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
