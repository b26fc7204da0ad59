"""Cleaning of a scene."""

from pydantic import Field, StrictBool, StrictInt

from spiked.cleaning import Box
from spiked_service.api.schemas.base import LARGEST_INTEGER, In, Out, Vector, examples

Newest = Field(ge=1, le=LARGEST_INTEGER, description="The newest version, which is edited; 409 if there is another.")


class BoxModel(In):
    """A box along the axes of the scene, in its unit."""

    model_config = examples({"low": [-1.0, -1.0, 0.0], "high": [1.0, 1.0, 4.0]})

    low: Vector
    high: Vector

    def box(self) -> Box:
        """The same for the library. Raises ConfigurationError for an empty one."""
        return Box(self.low, self.high)


class CleanRequest(In):
    """What is removed."""

    model_config = examples({"version": 12, "floaters": True})

    version: StrictInt = Newest
    box: BoxModel | None = Field(None, description="Splats outside are removed.")
    floaters: StrictBool = Field(True, description="Remove splats that few views see.")
    shrink: StrictBool = Field(
        False, description="With floaters: also make splats smaller that are larger than a quarter of the scene."
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
    floaters: int = Field(description="Splats that were removed as floaters.")
    shrunk: int = Field(description="Splats that were made smaller.")
