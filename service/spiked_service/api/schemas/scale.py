"""The scale of a scene, and which way is up in it."""

from typing import Self

from pydantic import Field, StrictFloat, StrictInt, model_validator

from spiked_service.api.schemas.base import LARGEST_INTEGER, In, Out, Vector, at_most_one_of, examples
from spiked_service.results.scene_scale import ScaleSource, SceneScale


class ScaleOut(Out):
    """Metres for the unit of length of a scene, and the direction of up; null where it is not known."""

    revision: int = Field(description="Counts the changes; 0: nothing is known. A change names the one it replaces.")
    metres_per_unit: float | None
    sigma: float | None = Field(description="Relative standard deviation of metres_per_unit; null: not known.")
    source: ScaleSource | None = Field(
        description="What the scale rests on: a known length, AprilTags, a board, or two cameras."
    )
    up: list[float] | None = Field(description="Direction in the scene, of length 1; null: -y is taken for up.")
    version: int | None = Field(description="Version of the scene that it was measured in.")
    since: int = Field(
        description="Versions up to this one are of an earlier run, whose unit of length is another one: the scale is "
        "not theirs, and cannot be measured in them."
    )

    @classmethod
    def of(cls, scale: SceneScale) -> "ScaleOut":
        """As it is shown."""
        return cls(**{**scale.model_dump(), "up": None if scale.up is None else list(scale.up)})


class ScaleRequest(In):
    """What is measured; what is left out stays as it is."""

    model_config = examples(
        {"revision": 0, "version": 12, "metres_per_unit": 2.11, "sigma": 0.004},
        {"revision": 1, "up": [0.0, -1.0, 0.0]},
    )

    revision: StrictInt = Field(ge=0, le=LARGEST_INTEGER, description="The one that this replaces; 409 if it is not.")
    version: StrictInt | None = Field(
        None,
        ge=1,
        le=LARGEST_INTEGER,
        description="Version that it was measured in; 409 for one of an earlier run. Default: the newest.",
    )
    metres_per_unit: StrictFloat | None = Field(None, gt=1e-9, lt=1e9)
    sigma: StrictFloat | None = Field(None, ge=0, le=10, description="Relative standard deviation, if known.")
    up: Vector | None = Field(None, description="Of any length but zero.")


class TagScaleRequest(In):
    """AprilTags of known size."""

    model_config = examples({"revision": 0, "side_m": 0.10})

    revision: StrictInt = Field(ge=0, le=LARGEST_INTEGER, description="The one that this replaces; 409 if it is not.")
    side_m: StrictFloat = Field(gt=0, le=100, description="Side of the black square.")
    family: str = Field("36h11", max_length=16, description="16h5, 25h9, 36h10 or 36h11.")


class BoardScaleRequest(In):
    """A ChArUco board of known size."""

    model_config = examples({"revision": 0, "board": "9x6", "square_m": 0.03})

    revision: StrictInt = Field(ge=0, le=LARGEST_INTEGER, description="The one that this replaces; 409 if it is not.")
    board: str = Field(max_length=16, description="Squares of the board, COLUMNSxROWS.")
    square_m: StrictFloat = Field(gt=0, le=100, description="Side of a square.")
    dictionary: str = Field("4x4_100", max_length=32, description="Markers of the board: one of OpenCV's sets.")


class BoardScaleOut(Out):
    """The scale by a board."""

    scale: ScaleOut
    square: float = Field(description="Side of a square, in the unit of the scene.")
    views: int
    corners: int = Field(description="Of the board, that were used.")
    error_px: float = Field(description="Root mean square error of its corners, px of the pictures.")


class BaselineScaleRequest(In):
    """The distance of two cameras of a rig, whose paths are in one map."""

    model_config = examples({"revision": 0, "baseline_m": 0.12}, {"revision": 0, "baseline_m": 0.12, "offset_s": 0.25})

    revision: StrictInt = Field(ge=0, le=LARGEST_INTEGER, description="The one that this replaces; 409 if it is not.")
    baseline_m: StrictFloat = Field(gt=0, le=1000, description="Distance of the cameras.")
    path: StrictInt = Field(
        1, ge=1, le=LARGEST_INTEGER, description="Path of the second camera, see GET paths; the first has path 0."
    )
    offset_s: StrictFloat | None = Field(
        None,
        ge=-1e6,
        le=1e6,
        description="Seconds by which the second recording began later. Default: by the clocks of both recordings, as "
        "`groups/ID` says it.",
    )


class BaselineScaleOut(Out):
    """The scale by a baseline."""

    scale: ScaleOut
    poses: int = Field(description="Moments at which both cameras have a pose.")
    offset_s: float = Field(description="Seconds by which the second recording began later.")


class UpRequest(In):
    """What up is found by: gravity at a frame, points of the floor, or neither: the floor is found."""

    model_config = examples(
        {"revision": 0},
        {"revision": 0, "gravity": [0.1, 9.7, 0.9], "frame": 100},
        {"revision": 0, "points": [[0.1, 1.2, 3.0], [0.9, 1.2, 3.1], [0.2, 1.3, 4.0]]},
        rules=at_most_one_of(gravity="array", points="array"),
    )

    revision: StrictInt = Field(ge=0, le=LARGEST_INTEGER, description="The one that this replaces; 409 if it is not.")
    gravity: Vector | None = Field(None, description="In the axes of the camera: x right, y down, z forward.")
    frame: StrictInt | None = Field(
        None, ge=0, le=LARGEST_INTEGER, description="Of gravity: the pose nearest to it is used. Default: the first."
    )
    points: list[Vector] | None = Field(None, min_length=3, max_length=100, description="Of the floor, in the scene.")

    @model_validator(mode="after")
    def _one(self) -> Self:
        if self.gravity is not None and self.points is not None:
            raise ValueError("gravity and points both say what is up; give one of them")
        return self


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
