"""The scale of a scene, and which way is up in it."""

from pydantic import Field, StrictFloat, StrictInt

from spiked_service.api.schemas.base import LARGEST_INTEGER, In, Out, Vector, examples
from spiked_service.results.scene_scale import ScaleSource, SceneScale


class ScaleOut(Out):
    """Metres for the unit of length of a scene, and the direction of up; null where it is not known."""

    revision: int = Field(description="Counts the changes; 0: nothing is known. A change names the one it replaces.")
    metres_per_unit: float | None
    sigma: float | None = Field(description="Relative standard deviation of metres_per_unit; null: not known.")
    source: ScaleSource | None = Field(description="What the scale rests on: a known length, or AprilTags.")
    up: list[float] | None = Field(description="Direction in the scene, of length 1; null: -y is taken for up.")
    version: int | None = Field(description="Version of the scene that it was measured in.")

    @classmethod
    def of(cls, scale: SceneScale) -> "ScaleOut":
        """As it is shown."""
        return cls(**{**scale.model_dump(exclude={"since"}), "up": None if scale.up is None else list(scale.up)})


class ScaleRequest(In):
    """What is measured; what is left out stays as it is."""

    model_config = examples(
        {"revision": 0, "metres_per_unit": 2.11, "sigma": 0.004},
        {"revision": 1, "up": [0.0, -1.0, 0.0]},
    )

    revision: StrictInt = Field(ge=0, le=LARGEST_INTEGER, description="The one that this replaces; 409 if it is not.")
    metres_per_unit: StrictFloat | None = Field(None, gt=1e-9, lt=1e9)
    sigma: StrictFloat | None = Field(None, ge=0, le=10, description="Relative standard deviation, if known.")
    up: Vector | None = Field(None, description="Of any length but zero.")


class TagScaleRequest(In):
    """AprilTags of known size."""

    model_config = examples({"revision": 0, "side_m": 0.10})

    revision: StrictInt = Field(ge=0, le=LARGEST_INTEGER, description="The one that this replaces; 409 if it is not.")
    side_m: StrictFloat = Field(gt=0, le=100, description="Side of the black square.")
    family: str = Field("36h11", max_length=16, description="16h5, 25h9, 36h10 or 36h11.")


class FoundTagOut(Out):
    """A tag in the scene."""

    tag: int
    views: int
    side: float = Field(description="In the unit of the scene.")
    sigma: float = Field(description="Relative standard deviation.")
    corners: list[list[float]] = Field(description="In the scene, [4, 3].")


class TagScaleOut(Out):
    """The scale by tags."""

    scale: ScaleOut
    tags: list[FoundTagOut]
