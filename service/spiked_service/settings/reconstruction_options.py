"""What can be chosen about a reconstruction: the one table for the command line, HTTP, workers and the page.

The defaults are the library's; names, limits and descriptions are here.
"""

from dataclasses import replace
from typing import Any, Self

from pydantic import BaseModel, ConfigDict, Field, StrictBool, StrictFloat, StrictInt, model_validator

from spiked.camera import MosaicChoice, Pinhole
from spiked.recon import Initialisation, LossName, MethodName, Options, PoseStepName
from spiked.sensor import Intrinsics, Sensor

_LIBRARY = Options()
MOST_SECONDS = 604_800.0
"""Upper bound of a time budget: a week."""


class IntrinsicsOption(Pinhole):
    """A pinhole camera behind a lens; pixels, the centre of the first pixel is (0.5, 0.5)."""


class ReconstructionOptions(BaseModel):
    """A reconstruction's options; the defaults suit a hand-held camera."""

    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        allow_inf_nan=False,
        json_schema_extra={
            "examples": [{"steps": 2000, "seed": 0}],
            "not": {
                "required": ["fov", "intrinsics"],
                "properties": {"fov": {"type": "number"}, "intrinsics": {"type": "object"}},
            },
        },
    )

    seconds: StrictFloat | None = Field(
        default=None,
        gt=0,
        le=MOST_SECONDS,
        description="Time budget in seconds of work: reduces the steps, and at last the frames that are read; of a "
        "live reconstruction it is that of the refinement. Without it all steps are done.",
    )

    steps: StrictInt = Field(
        default=_LIBRARY.steps,
        ge=0,
        le=200_000,
        description="Gradient steps of the refinement after the last frame; its time grows with them.",
    )
    seed: StrictInt = Field(
        default=_LIBRARY.seed, ge=0, le=2**32 - 1, description="Same input, options and seed: same result."
    )
    window_frames: StrictInt | None = Field(
        default=_LIBRARY.window_frames,
        ge=2,
        le=256,
        description="Frames of a view; follows the motion (4 to 64) if not given.",
    )
    threads: StrictInt | None = Field(
        default=_LIBRARY.threads, ge=1, le=256, description="Threads of the rasteriser; all cores if not given."
    )
    max_views: StrictInt = Field(
        default=_LIBRARY.max_views, ge=20, le=5000, description="Views kept for mapping; beyond it older ones thin out."
    )
    most_splats: StrictInt = Field(
        default=_LIBRARY.mapping.most_splats,
        ge=1000,
        le=10_000_000,
        description="Most splats of the map, which has no more than follow from the size of the picture. Ten times as "
        "many make a step about five times as long.",
    )
    memory_mb: StrictInt = Field(
        default=_LIBRARY.memory_mb,
        ge=16,
        le=2**20,
        description="MiB of images held in memory; the others are built anew from the recording.",
    )
    refine_poses: StrictBool = Field(
        default=_LIBRARY.refine_poses, description="Whether the map corrects the trajectory."
    )

    method: MethodName = Field(
        default=_LIBRARY.method,
        description="spiked, or nope-sgs: the method of 3D Gaussian Splatting from Unposed Spike Streams, to compare.",
    )
    initialisation: Initialisation | None = Field(
        default=_LIBRARY.initialisation, description="How the path begins; as in the method if not given."
    )
    pose_step: PoseStepName | None = Field(
        default=_LIBRARY.pose_step,
        description="What corrects the poses while the map is fitted; as in the method if not given.",
    )
    loss: LossName | None = Field(
        default=_LIBRARY.loss,
        description="What the map is fitted to; as in the method if not given.",
    )

    intrinsics: IntrinsicsOption | None = Field(
        default=None, description="Optics, where neither the capture nor its recording says them, or to overrule them."
    )
    fov: StrictFloat | None = Field(
        default=None,
        ge=1,
        le=170,
        description="The same as a horizontal field of view in degrees of square pixels; a distortion that is known "
        "stays. Without any optics they are estimated.",
    )
    mosaic: MosaicChoice | None = Field(
        default=None,
        description="Colour mosaic of the upright image, where the recording states another or none; auto: detect it "
        "from the pixels of the recording.",
    )
    flipped: StrictBool | None = Field(
        default=None, description="Rows come bottom-up; false: top-down; as the recording states if not given."
    )

    @model_validator(mode="after")
    def _one_kind_of_optics(self) -> Self:
        if self.fov is not None and self.intrinsics is not None:
            raise ValueError("fov and intrinsics both set the focal length; give one of them")
        return self

    def geometry(self) -> dict[str, Any]:
        """What is stated of the camera, by which `open_recording` reads."""
        return {"flipped": self.flipped, "mosaic": None if self.mosaic is None else self.mosaic.mosaic}

    def sensor(self, base: Sensor, known: Intrinsics | None) -> Sensor:
        """`base` with what is stated here in place of its own; `known`: the optics of the capture, with these options.

        Raises ConfigurationError for an impossible sensor.
        """
        optics = known or base.intrinsics
        if self.fov is not None:
            lens = None if optics is None else optics.distortion
            optics = Intrinsics.from_fov(base.width, base.height, self.fov, lens)
        stated = {name: value for name, value in self.geometry().items() if value is not None}
        return replace(base, intrinsics=optics, **stated)

    def options(self) -> Options:
        """The same for the library."""
        return Options(
            window_frames=self.window_frames,
            steps=self.steps,
            seed=self.seed,
            threads=self.threads,
            max_views=self.max_views,
            memory_mb=self.memory_mb,
            refine_poses=self.refine_poses,
            method=self.method,
            initialisation=self.initialisation,
            pose_step=self.pose_step,
            loss=self.loss,
            mapping=replace(_LIBRARY.mapping, most_splats=self.most_splats),
        )
