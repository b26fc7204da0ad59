"""Cleaning of a scene."""

from typing import Annotated

import numpy as np
from pydantic import Field, StrictBool, StrictFloat, StrictInt

from spiked.cleaning import Box, Outline
from spiked.errors import ConfigurationError
from spiked_service.api.schemas.base import LARGEST_INTEGER, In, Out, Vector, examples
from spiked_service.api.schemas.views import CameraModel

_Slope = Annotated[StrictFloat, Field(ge=-1e6, le=1e6)]

Newest = Field(ge=1, le=LARGEST_INTEGER, description="The newest version, which is edited; 409 if there is another.")


class BoxModel(In):
    """A box along the axes of the scene, in its unit."""

    model_config = examples({"low": [-1.0, -1.0, 0.0], "high": [1.0, 1.0, 4.0]})

    low: Vector
    high: Vector

    def box(self) -> Box:
        """The same for the library. Raises ConfigurationError for an empty one."""
        return Box(self.low, self.high)


class OutlineModel(In):
    """An outline drawn over a view, and where that was seen from: c2w, or position and quaternion_wxyz."""

    model_config = examples(
        {
            "corners": [[-0.1, -0.1], [0.1, -0.1], [0.0, 0.1]],
            "camera": {"position": [0, 0, 0], "quaternion_wxyz": [1, 0, 0, 0]},
        }
    )

    corners: list[tuple[_Slope, _Slope]] = Field(
        min_length=3, max_length=1000, description="x/z and y/z in the camera's OpenCV axes, in order."
    )
    camera: CameraModel = Field(description="A frame cannot be given here.")

    def outline(self) -> Outline:
        """The same for the library. Raises ConfigurationError for a frame."""
        if self.camera.frame is not None:
            raise ConfigurationError("outline.camera: give c2w, or position and quaternion_wxyz; a frame is no view")
        pose = self.camera.pose()
        return Outline(np.array(self.corners), pose.rotation, pose.centre)


class CleanRequest(In):
    """What is removed."""

    model_config = examples({"version": 12, "floaters": True})

    version: StrictInt = Newest
    box: BoxModel | None = Field(None, description="Splats outside are removed.")
    outline: OutlineModel | None = Field(None, description="Splats inside are removed, however far behind it.")
    floaters: StrictBool = Field(True, description="Remove splats that few views see or that hang alone.")
    split: StrictBool = Field(
        True,
        description="With floaters: also replace splats larger than a quarter of the scene by smaller ones that show "
        "the same.",
    )


class RevertRequest(In):
    """An earlier version to go back to."""

    model_config = examples({"version": 13, "to": 12})

    version: StrictInt = Newest
    to: StrictInt = Field(ge=1, le=LARGEST_INTEGER, description="A version that is kept; `GET versions` lists them.")


class EditedOut(Out):
    """The version that was published, and what was done."""

    version: int
    splats: int
    outside: int = Field(description="Splats that lay outside the box.")
    outlined: int = Field(description="Splats that lay inside the outline.")
    floaters: int = Field(description="Splats that were removed as floaters.")
    split: int = Field(description="Splats larger than a quarter of the scene that were replaced by several.")
    shrunk: int = Field(description="Splats so large that were made smaller: no view sees them.")
    large: int = Field(description="Splats that stay so large: as several they would be too many.")
