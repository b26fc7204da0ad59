"""What can be chosen about a reconstruction: the one table for the command line, HTTP, workers and the page.

The defaults are the library's; names, limits and descriptions are here.
"""

from pydantic import BaseModel, ConfigDict, Field, StrictBool, StrictInt

from spiked.camera import Pinhole
from spiked.recon import Initialisation, LossName, MethodName, Options, PoseStepName

_LIBRARY = Options()


class IntrinsicsOption(Pinhole):
    """A pinhole camera behind a lens; pixels, the centre of the first pixel is (0.5, 0.5)."""


class ReconstructionOptions(BaseModel):
    """A reconstruction's options; the defaults suit a hand-held camera."""

    model_config = ConfigDict(frozen=True, extra="forbid", json_schema_extra={"examples": [{"steps": 2000, "seed": 0}]})

    steps: StrictInt = Field(
        default=_LIBRARY.steps, ge=0, le=200_000, description="Gradient steps of the refinement after the last frame."
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
        )
