"""What goes over HTTP, with an example of each."""

from typing import Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from spiked.pose import rotation_of
from spiked.sensor import Intrinsics
from spiked_service.api.schemas.captures import CaptureOut as NewCaptureOut
from spiked_service.api.schemas.reconstructions import ReconstructionOut
from spiked_service.snapshot import Snapshot

Array = NDArray[np.float64]


class _Schema(BaseModel):
    model_config = ConfigDict(extra="forbid")


class DeviceOut(BaseModel):
    """Something to capture from."""

    source: str = Field(description="To be given as `source` of a capture.")
    kind: str
    description: str


class IntrinsicsModel(_Schema):
    """A pinhole camera; pixels, the centre of the first pixel is (0.5, 0.5)."""

    fx: float = Field(gt=0)
    fy: float = Field(gt=0)
    cx: float
    cy: float

    def intrinsics(self) -> Intrinsics:
        """The same for the library."""
        return Intrinsics(self.fx, self.fy, self.cx, self.cy)


class CaptureRequest(_Schema):
    """A capture to start."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={"examples": [{"source": "sim:?seed=1", "frames": 1280}, {"source": "replay:rec.dat"}]},
    )
    source: str = Field(description="sim: or replay:FILE, with options after a question mark; without pace it waits.")
    frames: int | None = Field(None, gt=0, description="Length; until the source ends or is stopped if not given.")
    seconds: float | None = Field(None, gt=0, description="Length in seconds of the camera, instead of frames.")
    seed: int = 0
    steps: int = Field(4000, ge=0, le=200_000, description="Gradient steps of the refinement after the last frame.")
    intrinsics: IntrinsicsModel | None = Field(None, description="If the source does not know its own.")

    @model_validator(mode="after")
    def _one_length(self) -> Self:
        if self.frames is not None and self.seconds is not None:
            raise ValueError("frames and seconds both say how long to capture; give one of them")
        return self


class CaptureOut(NewCaptureOut):
    """A capture with its newest reconstruction."""

    reconstruction: ReconstructionOut | None

    @classmethod
    def shown(cls, snapshot: Snapshot) -> "CaptureOut":
        """A snapshot as it is shown."""
        ids = [row.id for row in snapshot.reconstructions]
        base = NewCaptureOut.of(snapshot.row, snapshot.counters, ids)
        newest = snapshot.reconstructions[-1] if snapshot.reconstructions else None
        return cls(**vars(base), reconstruction=ReconstructionOut.of(newest) if newest else None)


class TrajectoryOut(BaseModel):
    """Camera-to-world poses, OpenCV axes."""

    version: int
    times_s: list[float]
    positions: list[list[float]] = Field(description="[n, 3], length unit of the scene.")
    quaternions_wxyz: list[list[float]] = Field(description="[n, 4]")


class ViewRequest(_Schema):
    """A camera to look through: c2w, or position and quaternion_wxyz; the capture's own optics if none are given."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "examples": [
                {"position": [0, 0, 0], "quaternion_wxyz": [1, 0, 0, 0]},
                {
                    "c2w": [[1, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
                    "width": 640,
                    "height": 400,
                    "intrinsics": {"fx": 550, "fy": 550, "cx": 320, "cy": 200},
                },
            ]
        },
    )
    c2w: list[list[float]] | None = Field(None, description="Camera to world, 4x4, rows.")
    position: tuple[float, float, float] | None = None
    quaternion_wxyz: tuple[float, float, float, float] | None = None
    intrinsics: IntrinsicsModel | None = None
    width: int | None = Field(None, ge=1, le=4096)
    height: int | None = Field(None, ge=1, le=4096)
    white: float | None = Field(None, gt=0, description="Radiance shown as white in PNG; the scene's own if not given.")

    @model_validator(mode="after")
    def _one_pose(self) -> Self:
        by_parts = self.position is not None and self.quaternion_wxyz is not None
        if (self.c2w is not None) == by_parts:
            raise ValueError("give either c2w, or position and quaternion_wxyz")
        rotation, centre = self.pose()
        if not (np.isfinite(rotation).all() and np.isfinite(centre).all()):
            raise ValueError("the pose holds values that are not finite")
        if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3 or np.linalg.det(rotation) < 0:
            raise ValueError("the upper left of c2w is not a rotation")
        if (self.width is None) != (self.height is None):
            raise ValueError("give width and height together")
        if self.width is not None and self.intrinsics is None:
            raise ValueError("a size of your own needs intrinsics of your own")
        return self

    def pose(self) -> tuple[Array, Array]:
        """Rotation [3, 3] and centre [3], camera to world. Raises ValueError for a matrix of another shape."""
        if self.c2w is not None:
            if [len(row) for row in self.c2w] != [4] * 4:
                raise ValueError("c2w is 4 rows of 4 numbers")
            matrix = np.array(self.c2w)
            return matrix[:3, :3], matrix[:3, 3]
        quaternion = np.array(self.quaternion_wxyz)
        if np.linalg.norm(quaternion) < 1e-6:
            raise ValueError("quaternion_wxyz is zero")
        return rotation_of(quaternion), np.array(self.position)
