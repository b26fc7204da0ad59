"""What the service and its workers say to each other: one JSON object a line, orders on stdin, news on stdout."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, Field, TypeAdapter

from spiked.recon import State
from spiked.recording.sidecar import Sidecar
from spiked.sensor import BitOrder, Intrinsics, Layout, Mosaic, Sensor
from spiked_service.payloads import PosePayload
from spiked_service.reconstruction_options import ReconstructionOptions


class Role(StrEnum):
    """What a worker process is for."""

    ACQUISITION = "acquisition"
    RECORDER = "recorder"
    RECONSTRUCTION = "reconstruction"
    PREVIEW = "preview"
    UPLOAD = "upload"


class _Order(BaseModel):
    """What every order says."""

    capture_id: str | None = None
    reconstruction_id: str | None = None
    """Whose work it is, for the log."""


class AcquisitionOrder(_Order):
    """Move a source into a new ring."""

    role: Literal[Role.ACQUISITION] = Role.ACQUISITION
    source: str
    ring_id: str
    frames: int | None
    seconds: float | None
    consumers: int
    """Readers to wait for before the first frame."""
    history_s: float
    """What the ring shall hold for readers that begin in the past."""
    backlog_s: float = 0.0
    """What it shall hold of a source that does not wait, for a reader that pauses and then catches up."""
    ring: str | None = None
    """Go on in this ring, whose writer has died."""
    died_s: float | None = None
    """When it did, by the monotonic clock."""


class RecorderOrder(_Order):
    """Write what comes through a ring into a recording."""

    role: Literal[Role.RECORDER] = Role.RECORDER
    ring: str
    path: Path
    first_frame: int
    """Index in the ring of the capture's first frame."""
    stop_frame: int | None
    """One past the index in the ring of its last frame; None: what the ring ends with."""
    resume: bool
    """Go on with what a killed recorder has left."""
    intrinsics: Intrinsics | None
    source: str
    note: str


class ReconstructionOrder(_Order):
    """Reconstruct what comes through a ring, or lies in a recording, and publish it in a folder."""

    role: Literal[Role.RECONSTRUCTION] = Role.RECONSTRUCTION
    ring: str | None
    recording: Path | None
    """Instead of a ring."""
    folder: Path
    unhurried: bool
    """The source waits for its consumers, so that there is time to map between frames."""
    options: ReconstructionOptions
    intrinsics: Intrinsics | None
    first_frame: int = 0
    stop_frame: int | None = None
    recorded: bool = False
    """A recording is made at the same time, from which all can be reconstructed once more."""
    least_poses: int = 0
    """A path of fewer is published only at the end: a longer one is there already."""


class PreviewOrder(_Order):
    """Make pictures of the newest frames of a ring."""

    role: Literal[Role.PREVIEW] = Role.PREVIEW
    ring: str
    thumbnail: Path | None
    """Where to leave one of them."""


class StatedGeometry(BaseModel):
    """What somebody said of a recording; None: nothing."""

    width: int | None = None
    height: int | None = None
    frame_rate_hz: float | None = None
    layout: Layout | None = None
    bit_order: BitOrder | None = None
    flipped: bool | None = None
    mosaic: Mosaic | None = None
    intrinsics: Intrinsics | None = None


class UploadOrder(_Order):
    """Look at every byte of a recording from elsewhere, and leave its sidecar beside it."""

    role: Literal[Role.UPLOAD] = Role.UPLOAD
    path: Path
    sha256: str | None
    sidecar: Sidecar | None
    geometry: StatedGeometry


Order = Annotated[
    AcquisitionOrder | RecorderOrder | ReconstructionOrder | PreviewOrder | UploadOrder,
    Field(discriminator="role"),
]
STOP = "stop\n"
"""The order line that asks a worker to end in good order; the end of its stdin asks it to go at once."""


class RingOpened(BaseModel):
    """Acquisition has made its ring; its consumers may attach."""

    news: Literal["ring_opened"] = "ring_opened"
    name: str
    sensor: Sensor
    frames: int | None
    unhurried: bool


class Warned(BaseModel):
    """Something that the user should know, and that the worker does without."""

    news: Literal["warned"] = "warned"
    text: str


class RecordingEnded(BaseModel):
    """The recorder has closed its recording."""

    news: Literal["recording_ended"] = "recording_ended"
    frames: int
    bytes: int
    lost: dict[str, int]
    """Frames, by cause."""
    trouble: str
    """What the disk refused; empty if nothing."""
    dark: bool
    """No pixel fired in any frame looked at."""
    saturated: bool
    """Every pixel fired in every frame looked at."""
    died: bool
    """The acquisition ended without a word."""


class Stage(StrEnum):
    """What a reconstruction is at."""

    WAITING = "waiting"
    TRACKING = "tracking"
    MAPPING = "mapping"
    REFINING = "refining"
    DONE = "done"


class ReconstructionStatus(BaseModel):
    """Where a reconstruction stands."""

    news: Literal["reconstruction"] = "reconstruction"
    state: State
    reason: str = Field(description="Why the state is what it is; empty while all is well.")
    stage: Stage
    frames: int = Field(description="Frames taken so far.")
    splats: int
    loss: float | None = Field(description="Mean squared error of the views, in units of white squared.")
    progress: float = Field(description="Share of the final refinement done, 0 to 1.")
    poses: int = Field(description="Frames that have a pose in the published trajectory.")
    version: int = Field(description="Number of the newest published scene and trajectory; 0: none yet.")
    psnr_db: float | None = None
    eta_s: float | None = None


class Posed(BaseModel):
    """One more view was tracked."""

    news: Literal["pose"] = "pose"
    pose: PosePayload


class Outpaced(BaseModel):
    """A camera was faster than the tracker, which has passed over frames; all of them are recorded."""

    news: Literal["outpaced"] = "outpaced"
    frames: int
    passed: int


class VersionPublished(BaseModel):
    """A version lies in the folder."""

    news: Literal["version"] = "version"
    version: int
    splats: int
    poses: int
    white: float
    scene_bytes: int
    psnr_db: float | None
    kept: list[int]
    """All versions that are still there."""


class PreviewKind(StrEnum):
    """What a live picture shows."""

    INTERVAL = "interval"
    """Charge between spikes: the least noisy picture of a moment."""
    RATE = "rate"
    """Plain counts of a moment."""
    ACCUMULATION = "accumulation"
    """Plain counts of the last second or so."""


class PreviewTaken(BaseModel):
    """Pictures of the newest frames."""

    news: Literal["preview"] = "preview"
    frame: int
    """Index in the ring of the frame in the middle."""
    width: int
    height: int
    white: dict[PreviewKind, float]
    """Spikes a frame shown as white."""
    images: dict[PreviewKind, str]
    """WebP, base64."""
    mean_rate: float
    """Spikes a pixel and frame."""
    rate_histogram: list[int]
    """Pixels by rate, equal bins from 0 to 1 spike a frame."""
    hot_pixels: list[tuple[int, int]]
    """x, y of pixels that fire much more than those around them, at most 64."""


class Logged(BaseModel):
    """A line of the worker's log."""

    news: Literal["log"] = "log"
    level: str
    event: str
    logger: str
    known: dict[str, str]
    """Role, and whose work it is."""


class UploadChecked(BaseModel):
    """What a recording from elsewhere is."""

    news: Literal["upload_checked"] = "upload_checked"
    sensor: Sensor
    frames: int
    bytes: int
    lost: int
    """Frames in the gaps that its sidecar tells of."""
    sha256: str
    grade: str
    """As `spiked verify` judges it."""
    reasons: tuple[str, ...]


class Refused(BaseModel):
    """A worker cannot do what it was ordered, for a reason that is the user's to mend."""

    news: Literal["refused"] = "refused"
    reason: str


News = Annotated[
    RingOpened
    | Warned
    | RecordingEnded
    | ReconstructionStatus
    | Posed
    | Outpaced
    | VersionPublished
    | PreviewTaken
    | Logged
    | UploadChecked
    | Refused,
    Field(discriminator="news"),
]
orders: TypeAdapter[Order] = TypeAdapter(Order)
news_lines: TypeAdapter[News] = TypeAdapter(News)
