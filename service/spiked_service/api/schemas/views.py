"""What to look at a scene through."""

from typing import Annotated, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, StrictBool, StrictFloat, StrictInt, model_validator

from spiked.pose import rotation_of
from spiked_service.api.schemas.base import (
    Finite,
    In,
    IntrinsicsModel,
    Out,
    Quaternion,
    exactly_one_of,
    examples,
    together,
)
from spiked_service.results.view_renderer import Output, Pose

MAX_VIEWS = 100
"""Views of one request."""
MAX_SIDE = 4096
"""Sides of a view, pixels: the renderer's own limit."""
MAX_PIXELS = 32_000_000
"""Pixels of all views of one request: 32 views of 1000x1000."""

_Length = Annotated[StrictFloat, Field(ge=-1e9, le=1e9)]
_Light = Annotated[StrictFloat, Field(ge=0, le=1e6)]
Row = tuple[Finite, Finite, Finite, _Length]
Position = tuple[_Length, _Length, _Length]


class CameraModel(In):
    """Where a camera is, camera to world, OpenCV axes: c2w, or position and quaternion_wxyz, or frame."""

    model_config = examples(
        {"position": [0, 0, 0], "quaternion_wxyz": [1, 0, 0, 0]},
        {"c2w": [[1, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]},
        {"frame": 100},
        rules=[
            *exactly_one_of(c2w="array", position="array", frame="integer"),
            *together(position="array", quaternion_wxyz="array"),
        ],
    )

    c2w: tuple[Row, Row, Row, Row] | None = Field(None, description="4x4, rows.")
    position: Position | None = None
    quaternion_wxyz: Quaternion | None = Field(None, description="Of any length but zero.")
    frame: StrictInt | None = Field(
        None, ge=0, le=2**53 - 1, description="As the reconstructed camera was at this frame."
    )

    @model_validator(mode="after")
    def _one_pose(self) -> Self:
        parts = (self.position is not None, self.quaternion_wxyz is not None)
        if parts[0] != parts[1] or (self.c2w is not None) + parts[0] + (self.frame is not None) != 1:
            raise ValueError("give c2w, or position and quaternion_wxyz, or frame")
        if self.frame is None:
            self.pose()
        return self

    def pose(self) -> Pose:
        """The pose, unless it is that of a frame. Raises ValueError for what is no rotation."""
        if self.c2w is not None:
            matrix: NDArray[np.float64] = np.array(self.c2w)
            rotation, centre = matrix[:3, :3], matrix[:3, 3]
            with np.errstate(over="ignore", invalid="ignore"):
                odd = np.abs(rotation @ rotation.T - np.eye(3)).max()
            if not odd < 1e-3 or np.linalg.det(rotation) < 0 or (matrix[3] != [0, 0, 0, 1]).any():
                raise ValueError("c2w is not a rotation and a position above a row 0 0 0 1")
        else:
            quaternion = np.array(self.quaternion_wxyz)
            largest = np.abs(quaternion).max()
            if largest == 0:
                raise ValueError("quaternion_wxyz is zero")
            rotation, centre = rotation_of(quaternion / largest), np.array(self.position)
        return Pose(rotation, centre)


class PathModel(In):
    """Cameras along the reconstructed path, evenly in time."""

    model_config = examples({"count": 24}, {"from_s": 0.01, "to_s": 0.05, "count": 8})

    count: StrictInt = Field(ge=1, le=MAX_VIEWS)
    from_s: StrictFloat | None = Field(None, ge=0, le=1e9, description="From its beginning if not given.")
    to_s: StrictFloat | None = Field(None, ge=0, le=1e9, description="To its end if not given.")


class ViewRequest(In):
    """One camera gives a picture; several, or a path, give a ZIP of pictures."""

    model_config = examples(
        {"camera": {"position": [0, 0, 0], "quaternion_wxyz": [1, 0, 0, 0]}},
        {"camera": {"frame": 100}, "output": "depth"},
        {"path": {"count": 12}, "width": 200, "height": 125, "background": [0.1, 0.1, 0.1]},
        rules=[
            *exactly_one_of(camera="object", cameras="array", path="object"),
            *together(width="integer", height="integer"),
        ],
    )

    camera: CameraModel | None = None
    cameras: list[CameraModel] | None = Field(None, min_length=1, max_length=MAX_VIEWS)
    path: PathModel | None = None
    width: StrictInt | None = Field(None, ge=1, le=MAX_SIDE, description="Pixels; the sensor's own if not given.")
    height: StrictInt | None = Field(None, ge=1, le=MAX_SIDE)
    intrinsics: IntrinsicsModel | None = Field(
        None,
        description="Optics of the pictures; if not given the capture's own, scaled to the width, the height taken "
        "from or added to the middle.",
    )
    undistorted: StrictBool = Field(False, description="Without the distortion of the lens that these optics have.")
    background: tuple[_Light, _Light, _Light] = Field(
        (0.0, 0.0, 0.0), description="Red, green and blue behind the scene; 1 is white."
    )
    output: Output = Field(
        Output.COLOR,
        description="color; depth along the camera's axis in the scene's unit of length, 0 where nothing is; "
        "alpha, 0 to 1.",
    )
    white: StrictFloat | None = Field(
        None,
        gt=0,
        le=1e9,
        description="Value shown as white in all formats but EXR. If not given: for color the scene's own, for alpha "
        "1, for depth the largest of the picture. The header X-White says what was used.",
    )

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if sum(one is not None for one in (self.camera, self.cameras, self.path)) != 1:
            raise ValueError("give one of camera, cameras and path")
        if (self.width is None) != (self.height is None):
            raise ValueError("give width and height together")
        return self


class PointOut(Out):
    """What a scene has at a pixel of a frame."""

    version: int = Field(description="Of the scene.")
    frame: int = Field(description="Whose pose it is seen from.")
    opacity: float = Field(description="How opaque the scene is there, 0 to 1.")
    rate: list[float] = Field(description="Radiance in expected spikes a frame; red, green and blue of a colour scene.")
    depth: float | None = Field(
        None, description="Along the camera's axis, in the scene's unit of length; null below an opacity of 0.5."
    )
    depth_m: float | None = Field(None, description="The same in metres; null while the scale is not known.")
    depth_m_sigma: float | None = Field(
        None, description="Standard deviation of depth_m by that of the scale alone; null: not known."
    )
    position: list[float] | None = Field(None, description="Of the surface, in the axes of the scene; null as depth.")
