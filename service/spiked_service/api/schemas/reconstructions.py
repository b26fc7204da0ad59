"""Reconstructions and what they publish."""

from datetime import datetime
from typing import Annotated, Self

from pydantic import Field, StrictBool, StrictInt, model_validator

from spiked.recon import State
from spiked_service.api.schemas.base import (
    ID_EXAMPLE,
    LARGEST_INTEGER,
    Id,
    In,
    IntrinsicsModel,
    Name,
    Notes,
    Out,
    PageOut,
    at_most_one_of,
    example,
    examples,
)
from spiked_service.results.published import Published
from spiked_service.settings.reconstruction_options import ReconstructionOptions
from spiked_service.store.rows import FrameRange, JobState, ReconstructionRow, Stage, Task, VersionRow

Priority = Annotated[
    StrictInt, Field(ge=-100, le=100, description="Higher ones run earlier; live captures go before all.")
]
Threads = Annotated[StrictInt | None, Field(ge=1, le=256, description="All cores if not given.")]


class ReconstructionRequest(In):
    """A recording to reconstruct."""

    model_config = examples(
        {"capture_id": ID_EXAMPLE, "options": {"steps": 2000, "seed": 1}, "priority": 0},
        rules=at_most_one_of(poses="string", poses_of="string"),
    )

    capture_id: str = Field(min_length=1, max_length=64)
    options: ReconstructionOptions = Field(default_factory=ReconstructionOptions)
    priority: Priority = 0
    map: str | None = Field(
        None,
        min_length=1,
        max_length=64,
        description="A finished reconstruction of the same place: its map is extended by the recording, and the result "
        "is in its frame of reference.",
    )
    poses: str | None = Field(
        None,
        min_length=1,
        description="Known camera-to-world poses as the text of a TUM file, in seconds since the start of the capture: "
        "the map is fitted to them, and they are not changed. Poses between them are interpolated.",
    )
    poses_of: str | None = Field(
        None,
        min_length=1,
        max_length=64,
        description="Another reconstruction of the capture, whose newest path is taken as known poses.",
    )
    calibration_of: str | None = Field(
        None,
        min_length=1,
        max_length=4096,
        description="A device whose calibration corrects the rates, instead of that of the recording.",
    )

    @model_validator(mode="after")
    def _one_path(self) -> Self:
        if self.poses is not None and self.poses_of is not None:
            raise ValueError("poses and poses_of both give the path; give one of them")
        return self


class MergeRequest(In):
    """Another reconstruction of the same place, to be merged with the one of the path."""

    model_config = example(other=ID_EXAMPLE, seed=0)

    other: str = Field(min_length=1, max_length=64, description="A finished reconstruction.")
    seed: StrictInt = Field(0, ge=0, le=2**32 - 1, description="Of all random choices.")
    threads: Threads = None
    priority: Priority = 0


class LocaliseRequest(In):
    """A recording to look for in the map of the reconstruction of the path."""

    model_config = example(capture_id=ID_EXAMPLE, first_frame=20_000, frames=1000)

    capture_id: str = Field(min_length=1, max_length=64)
    first_frame: StrictInt = Field(0, ge=0, le=LARGEST_INTEGER, description="First frame to use, absolute index.")
    frames: StrictInt | None = Field(
        None, ge=1, le=LARGEST_INTEGER, description="Number of frames to use; 1,000 suffice. Default: all."
    )
    intrinsics: IntrinsicsModel | None = Field(
        None, description="Lens of the recording, if it does not state it. Default: that of the map."
    )
    threads: Threads = None
    priority: Priority = 0

    def part(self) -> FrameRange | None:
        """The frames to use; None: all."""
        if self.frames is None and self.first_frame == 0:
            return None
        return FrameRange(self.first_frame, self.frames or LARGEST_INTEGER)


class RestartRequest(In):
    """Begin a reconstruction anew, with other options if they are given."""

    model_config = example(options={"steps": 8000})

    options: ReconstructionOptions | None = None


class ReconstructionChange(In):
    """What can be changed of a reconstruction; fields that are not given stay."""

    model_config = example(name="2,000 steps", notes="sharper than the first")

    name: Name | None = None
    notes: Notes | None = None
    held: StrictBool | None = Field(
        None, description="Whether it stays in the queue; one that runs returns there, unless it follows its capture."
    )
    queue_place: StrictInt | None = Field(
        None,
        ge=1,
        le=LARGEST_INTEGER,
        description="Its new place in the queue, 1 is the next; beyond the end: the last. Only while it waits there. "
        "It takes the priority of the one that has this place.",
    )


class MapRefOut(Out):
    """A version of a reconstruction that is used as a map."""

    reconstruction_id: str
    version: int


class FrameRangeOut(Out):
    """Frames `first` to `first + count - 1`, by absolute index."""

    first: int
    count: int


class ReconstructionOut(Out):
    """A job: a reconstruction, live from a capture or from its recording, an extended or merged map, a localisation."""

    id: Id
    name: str
    notes: str
    capture_id: str = Field(description="The capture that its trajectory belongs to; of a merge that of the first map.")
    task: Task = Field(description="A localisation has the scene of the map, and the path of the recording in it.")
    maps: list[MapRefOut] = Field(description="What it uses; the result is in the frame of reference of the first.")
    recognised: bool | None = Field(
        description="Whether all show one place; null before that is known, and without maps. If false and the task is "
        "`extend`, the versions show the recording alone, in a frame of reference of their own."
    )
    part: FrameRangeOut | None = Field(description="Frames that are localised; null: all.")
    live: bool
    state: JobState
    node: str = Field(description="The machine that runs it or ran it last; empty: that of the service.")
    stage: Stage
    progress: float = Field(description="0 to 1.")
    tracking_state: State
    reason: str = Field(description="Why it failed, waits or tracks badly; empty while all is well.")
    warnings: list[str] = Field(description="What it found out about the camera, or had to assume.")
    priority: int
    user: str = Field(description="Name of the token with which it was queued; empty if none was needed.")
    options: ReconstructionOptions
    poses_from: str = Field(description="Given poses: the id of their reconstruction, or `file`; empty: estimated.")
    calibration_from: str = Field(description="Device of its calibration; empty: that of the recording, if any.")
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
    held: bool = Field(description="Whether it stays in the queue until it is let go.")
    eta_s: float | None = Field(
        description="Seconds to its end, those before its turn included; null where that is not known."
    )

    @classmethod
    def of(cls, row: ReconstructionRow) -> "ReconstructionOut":
        """A row as it is shown."""
        return cls.model_validate({name: getattr(row, name) for name in cls.model_fields}, from_attributes=True)


class ReconstructionPage(PageOut[ReconstructionOut]):
    """Reconstructions, newest first, or the queue in its order."""

    total: int | None = Field(None, description="Reconstructions in the queue; null unless it is listed in its order.")


class VersionOut(Out):
    """A published version of a scene and its trajectory."""

    version: int
    at: datetime
    splats: int
    poses: int
    white: float
    scene_bytes: int = Field(description="Size of the PLY file.")
    psnr_db: float | None
    intrinsics: IntrinsicsModel | None = Field(
        description="Of the camera, as it was given or as the reconstruction found it, with its lens; null: not known."
    )
    cleaned_from: int | None = Field(
        description="The version that `:clean` made it from, which undoes it; null: it was not cleaned."
    )

    @classmethod
    def of(cls, row: VersionRow, published: Published | None) -> "VersionOut":
        """A row as it is shown, with what the index of the folder has of the version, None if it has nothing."""
        ours = ("intrinsics", "cleaned_from")
        fields = {name: getattr(row, name) for name in cls.model_fields if name not in ours}
        return cls(
            **fields,
            intrinsics=IntrinsicsModel.of(None if published is None else published.camera),
            cleaned_from=None if published is None else published.cleaned_from,
        )


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


class PathOut(Out):
    """The path of one recording through the scene of a version."""

    path: int = Field(description="To be given as `path` of the trajectory; 0 is that of the reconstruction's capture.")
    capture_id: str = Field(description="Its capture, which may have been removed since.")
    poses: int


class PathsOut(Out):
    """The paths of a version, more than one if its map is of several recordings."""

    version: int
    items: list[PathOut]


class LocalisedViewOut(Out):
    """Where the camera was in one window of frames, in the frame of reference and the unit of the map."""

    frame: int = Field(description="In the middle of the window.")
    time_s: float
    rotation: list[list[float]] = Field(description="Camera to world, [3, 3].")
    position: list[float]
    inliers: int = Field(description="Points of the map that agree within 1.5 px.")
    inlier_share: float = Field(description="Of those in view.")
    correlation: float = Field(description="Of the details of the image with those of the map rendered there.")
    sigma: float = Field(description="Predicted standard deviation of the position.")
    sigma_px: float = Field(description="The same in the image.")


class LocalisationOut(Out):
    """Where a camera was in a map, and how sure that is."""

    recognised: bool
    reason: str = Field(description="Why it was or was not recognised.")
    searches: int = Field(description="Views that were searched for in the whole map.")
    agreeing: int = Field(description="Searches that found the pose that the path has there.")
    references: int = Field(description="Reference views of the map.")
    best_inliers: int = Field(description="Most points that agreed with one pose in a search.")
    views: list[LocalisedViewOut] = Field(description="In order of time; empty if the place was not recognised.")


class SimilarityOut(Out):
    """x in the first map is scale * rotation * x in the other, plus translation."""

    scale: float
    rotation: list[list[float]]
    translation: list[float]


class RegistrationOut(Out):
    """How two maps, or a map and a recording, were brought together."""

    joined: bool
    reason: str = Field(description="Why they were not; empty if they were. Then there are figures.")
    similarity: SimilarityOut | None = None
    scale_range: list[float] | None = Field(None, description="Smallest and largest scale along the second way.")
    scale_sigma: float | None = Field(None, description="Predicted relative standard deviation of the scale.")
    turn_sigma_deg: float | None = None
    shift_sigma: float | None = None
    residual_px: float | None = Field(None, description="Median distance of common points.")
    searched: int | None = Field(None, description="Views of the second that were searched for in the first.")
    recognised: int | None = Field(None, description="Of these, views that were found.")
    agreeing: int | None = Field(None, description="Views that agree on how the two lie to each other.")
    views_alike: int | None = None
    views_different: int | None = None
    brightness: float | None = Field(None, description="Radiance of the first over that of the second.")
    splats_kept: list[int] | None = Field(None, description="Of the first and of the second.")
    psnr_db: list[float] | None = Field(None, description="How well the result shows what each of them showed.")


class GapOut(Out):
    """Frames that are missing."""

    first: int
    count: int
    cause: str


class ClosureOut(Out):
    """A closed loop: the camera sees at the later time what it saw at the earlier one; seconds since the start."""

    earlier_s: float
    later_s: float


class WorkOut(Out):
    """The map over the seconds of work, after the last frame, too; arrays of the same length."""

    work_s: list[float]
    loss: list[float]
    psnr_db: list[float | None]
    splats: list[int]


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
    work_s: list[float | None] = Field(description="Seconds of work when the view was tracked.")
    work: WorkOut
    gaps: list[GapOut]
    closures: list[ClosureOut] = Field(description="In the order in which they were closed.")
