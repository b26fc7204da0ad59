"""Reconstructions and what they publish."""

from datetime import datetime

from pydantic import Field, StrictInt

from spiked.recon import State
from spiked_service.api.schemas.base import ID_EXAMPLE, Id, In, Out, PageOut, example
from spiked_service.settings.reconstruction_options import ReconstructionOptions
from spiked_service.store.rows import JobState, ReconstructionRow, Stage, VersionRow


class ReconstructionRequest(In):
    """A recording to reconstruct."""

    model_config = example(capture_id=ID_EXAMPLE, options={"steps": 2000, "seed": 1}, priority=0)

    capture_id: str = Field(min_length=1, max_length=64)
    options: ReconstructionOptions = Field(default_factory=ReconstructionOptions)
    priority: StrictInt = Field(0, ge=-100, le=100, description="Higher ones run earlier; live captures go before all.")


class RestartRequest(In):
    """Begin a reconstruction anew, with other options if they are given."""

    model_config = example(options={"steps": 8000})

    options: ReconstructionOptions | None = None


class ReconstructionOut(Out):
    """A reconstruction, live from a capture or from its recording."""

    id: Id
    capture_id: str
    live: bool
    state: JobState
    stage: Stage
    progress: float = Field(description="0 to 1.")
    tracking_state: State
    reason: str = Field(description="Why it failed, waits or tracks badly; empty while all is well.")
    priority: int
    options: ReconstructionOptions
    created_at: datetime
    started_at: datetime | None
    ended_at: datetime | None
    frames: int = Field(description="Frames taken so far.")
    poses: int = Field(description="Frames that have a pose in the published trajectory.")
    splats: int
    loss: float | None = Field(description="Mean squared error of the views, in units of white squared.")
    psnr_db: float | None
    version: int = Field(description="Number of the newest published scene and trajectory; 0: none yet.")
    white: float | None = Field(description="Radiance shown as white in that version, spikes a frame.")
    queue_place: int | None = Field(description="1 is the next to begin; null unless it waits in the queue.")
    eta_s: float | None = Field(
        description="Seconds to its end, those before its turn included; null where that is not known."
    )

    @classmethod
    def of(cls, row: ReconstructionRow) -> "ReconstructionOut":
        """A row as it is shown."""
        return cls.model_validate({name: getattr(row, name) for name in cls.model_fields})


class ReconstructionPage(PageOut[ReconstructionOut]):
    """Reconstructions, newest first."""


class VersionOut(Out):
    """A published version of a scene and its trajectory."""

    version: int
    at: datetime
    splats: int
    poses: int
    white: float
    scene_bytes: int = Field(description="Size of the PLY file.")
    psnr_db: float | None

    @classmethod
    def of(cls, row: VersionRow) -> "VersionOut":
        """A row as it is shown."""
        return cls.model_validate({name: getattr(row, name) for name in cls.model_fields})


class VersionsOut(Out):
    """The versions that are kept, oldest first."""

    items: list[VersionOut]


class TrajectoryOut(Out):
    """Camera-to-world poses, OpenCV axes; one for each frame that has one, arrays of the same length."""

    version: int
    frames: list[int] = Field(description="Absolute frame indices.")
    times_s: list[float] = Field(description="Middle of each frame, seconds since the start of the capture.")
    positions: list[list[float]] = Field(description="[n, 3], length unit of the scene.")
    quaternions_wxyz: list[list[float]] = Field(description="[n, 4]")
    states: list[State | None] = Field(description="State of the tracking then; null where it is not known.")


class GapOut(Out):
    """Frames that are missing."""

    first: int
    count: int
    cause: str


class ClosureOut(Out):
    """A closed loop: the camera sees at the later time what it saw at the earlier one; seconds since the start."""

    earlier_s: float
    later_s: float


class TimelineOut(Out):
    """How a reconstruction went, arrays of the same length; null where a value is not known."""

    time_s: list[float] = Field(description="Since the start of the capture.")
    frame: list[int]
    state: list[State]
    chi2: list[float | None]
    sigma_px: list[float | None]
    rate: list[float | None] = Field(description="Mean spikes a pixel and frame.")
    loss: list[float | None]
    psnr_db: list[float | None]
    splats: list[int | None]
    gaps: list[GapOut]
    closures: list[ClosureOut] = Field(description="In the order in which they were closed.")
