"""Messages between the service and its workers: one JSON object a line, commands on stdin, events on stdout."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, Field, TypeAdapter

from spiked.camera import StoredCameraOptions
from spiked.export import ExportOptions
from spiked.frame_of_reference import KnownScale
from spiked.profile import CameraProfile
from spiked.recon import State
from spiked.recording.geometry import Assumable
from spiked.recording.sidecar import Sidecar
from spiked.sensor import Intrinsics, Sensor
from spiked_service.conversion.form import Form
from spiked_service.events.payloads import PosePayload
from spiked_service.results.published import Published
from spiked_service.settings.reconstruction_options import ReconstructionOptions
from spiked_service.store.rows import FrameRange, Stage


class Role(StrEnum):
    """Task of a worker process."""

    ACQUISITION = "acquisition"
    RECORDER = "recorder"
    RECONSTRUCTION = "reconstruction"
    PREVIEW = "preview"
    UPLOAD = "upload"
    LOCALISATION = "localisation"
    MERGE = "merge"
    EXPORT = "export"
    VIDEO = "video"


class _Command(BaseModel):
    """Fields of every command."""

    capture_id: str | None = None
    reconstruction_id: str | None = None
    """Capture and reconstruction that the work belongs to, for the log."""


class AcquisitionCommand(_Command):
    """Write the frames of a source into a ring."""

    role: Literal[Role.ACQUISITION] = Role.ACQUISITION
    source: str
    ring_id: str
    frames: int | None
    seconds: float | None
    consumers: int
    """Readers that must attach before the first frame."""
    keeper: int = 0
    """Process that keeps the ring's name until all readers have reached the end; see `RingWriter.create`."""
    history_s: float
    """Seconds that the ring holds for readers that start in the past."""
    backlog_s: float = 0.0
    """Seconds that the ring holds of a source that cannot block, for readers that catch up after a pause."""
    ring: str | None = None
    """Existing ring to continue, whose writer has died."""
    died_s: float | None = None
    """Time of its death on the monotonic clock."""
    profiles: Path | None = None
    """Folder of camera profiles."""


class RecorderCommand(_Command):
    """Write the frames of a ring into a recording."""

    role: Literal[Role.RECORDER] = Role.RECORDER
    ring: str
    path: Path
    first_frame: int
    """Ring index of the first frame of the capture."""
    stop_frame: int | None
    """Ring index after its last frame; None: the end of the ring."""
    resume: bool
    """Continue the recording of a recorder that was killed."""
    intrinsics: Intrinsics | None
    source: str
    note: str
    profile: CameraProfile | None = None
    """The profile of the camera, for the sidecar."""
    calibration: Path | None = None
    """Calibration of the camera; it is copied to the recording."""
    assumed: tuple[Assumable, ...] = ()
    """Properties of the sensor that nobody stated, for the sidecar."""


class ReconstructionCommand(_Command):
    """Reconstruct the frames of a ring or of a recording and publish versions in a folder."""

    role: Literal[Role.RECONSTRUCTION] = Role.RECONSTRUCTION
    ring: str | None
    recording: Path | None
    """Instead of a ring."""
    folder: Path
    can_block: bool
    """The source waits for its readers, which gives the mapper time between frames."""
    options: ReconstructionOptions
    intrinsics: Intrinsics | None
    calibration: Path | None = None
    """Of the frames of a ring, or instead of that which a recording names."""
    poses: Path | None = None
    """TUM file of poses that are not estimated."""
    questions: tuple[str, ...] = ()
    """What nothing states of the camera of a ring; a recording has its own."""
    first_frame: int = 0
    stop_frame: int | None = None
    recorded: bool = False
    """The capture is recorded, so that it can be reconstructed again with all frames."""
    least_poses: int = 0
    """Trajectories with fewer poses are published only at the end, because a longer one exists."""
    map: Path | None = None
    """Folder of a `PinnedMap` that is extended in the end."""


class LocalisationCommand(_Command):
    """Find where the camera of a recording was in a map; publish its path in the map's scene in a folder."""

    role: Literal[Role.LOCALISATION] = Role.LOCALISATION
    recording: Path
    folder: Path
    map: Path
    """Folder of a `PinnedMap`."""
    intrinsics: Intrinsics | None
    part: FrameRange | None
    threads: int | None


class MergeCommand(_Command):
    """Make one map of two and publish it in a folder."""

    role: Literal[Role.MERGE] = Role.MERGE
    folder: Path
    maps: tuple[Path, Path]
    """Folders of `PinnedMap`s."""
    seed: int
    threads: int | None


class PreviewCommand(_Command):
    """Render preview images of the newest frames of a ring."""

    role: Literal[Role.PREVIEW] = Role.PREVIEW
    ring: str
    thumbnail: Path | None
    """File for one of them."""


class UploadCommand(_Command):
    """Verify every byte of an uploaded recording and write its sidecar."""

    role: Literal[Role.UPLOAD] = Role.UPLOAD
    path: Path
    sha256: str | None
    sidecar: Sidecar | None
    camera: StoredCameraOptions
    """Wins over the sidecar."""
    form: Form | None
    """None: a recording with a sidecar or a stated layout, otherwise detected."""
    array: str | None
    """Name of an array in the file."""
    calibration: Path | None = None
    """Gains, dark rates and dead pixels of its camera, checked here."""
    limit_bytes: int
    """Most bytes of the recording that the file is converted to."""

    @property
    def converted(self) -> Path:
        """The recording that the file is converted to, unless it is one."""
        return self.path.with_suffix(".dat")


class ExportCommand(_Command):
    """Write a published version in the format of another program."""

    role: Literal[Role.EXPORT] = Role.EXPORT
    kind: str
    out: Path
    """The file; a folder becomes a ZIP."""
    options: ExportOptions
    name: str
    """Of files."""
    title: str
    """For people."""
    scene: Path
    poses: Path
    white: float
    sensor: Sensor | None
    recording: Path | None
    first_frame: int
    """Index in the capture of the recording's first frame."""
    scale: KnownScale
    """Of the scene."""
    metric: bool
    """Whether to write it in metres, by that scale, which is then known."""


class VideoCommand(_Command):
    """Write a recording in slow motion as an MP4."""

    role: Literal[Role.VIDEO] = Role.VIDEO
    recording: Path
    out: Path
    slower: float | None
    """Seconds of video for a second of recording; None: a video of ten seconds."""
    pictures_a_second: float
    window: int
    """Frames of a picture."""
    compensated: bool
    """Whether neighbouring pictures are moved onto each and averaged with it."""
    begin_s: float
    end_s: float | None
    """Part of the recording, times of the capture; None: to its end."""


Command = Annotated[
    AcquisitionCommand
    | RecorderCommand
    | ReconstructionCommand
    | LocalisationCommand
    | MergeCommand
    | PreviewCommand
    | UploadCommand
    | ExportCommand
    | VideoCommand,
    Field(discriminator="role"),
]
JobCommand = ReconstructionCommand | LocalisationCommand | MergeCommand
"""Commands of the queue of reconstructions."""
STOP = "stop\n"
"""Line that asks a worker to finish and exit. The end of its stdin asks it to exit at once."""


class RingOpened(BaseModel):
    """The acquisition has created its ring; readers may attach."""

    type: Literal["ring_opened"] = "ring_opened"
    name: str
    sensor: Sensor
    frames: int | None
    can_block: bool
    profile: CameraProfile | None = None
    calibration: Path | None = None
    assumed: tuple[Assumable, ...] = ()
    """Properties of the sensor that nobody stated."""


class Warned(BaseModel):
    """A warning for the user; the worker continues."""

    type: Literal["warned"] = "warned"
    text: str


class RecordingFailed(BaseModel):
    """Writing to the disk failed; the recorder counts the remaining frames as lost."""

    type: Literal["recording_failed"] = "recording_failed"
    reason: str


class RecordingEnded(BaseModel):
    """The recorder has closed its recording."""

    type: Literal["recording_ended"] = "recording_ended"
    frames: int
    bytes: int
    lost: dict[str, int]
    """Frames, by cause."""
    trouble: str
    """Error of the disk; empty if there was none."""
    dark: bool
    """No pixel fired in any sampled frame."""
    saturated: bool
    """Every pixel fired in every sampled frame."""
    died: bool
    """The acquisition died."""


class NodeFound(BaseModel):
    """A machine has taken the job."""

    type: Literal["node"] = "node"
    node: str


class NotBegun(BaseModel):
    """The attempt is over before any machine has taken the job, for a reason that is not the job's."""

    type: Literal["not_begun"] = "not_begun"


class ReconstructionStatus(BaseModel):
    """Progress of a reconstruction."""

    type: Literal["reconstruction"] = "reconstruction"
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
    warnings: tuple[str, ...] = ()


class PoseEstimated(BaseModel):
    """The pose of one more view was estimated."""

    type: Literal["pose"] = "pose"
    pose: PosePayload


class FramesSkipped(BaseModel):
    """The tracker skipped frames to keep up with the camera; all of them are recorded."""

    type: Literal["frames_skipped"] = "frames_skipped"
    frames: int
    skipped: int


class PlaceCompared(BaseModel):
    """Whether a map and a recording, or two maps, show the same place."""

    type: Literal["place_compared"] = "place_compared"
    recognised: bool
    reason: str
    """Why they do not, in one sentence."""


class VersionPublished(BaseModel):
    """A version was published in the folder."""

    type: Literal["version"] = "version"
    published: Published
    kept: list[int]
    """All versions that still exist."""
    again_of: int | None = None
    """Earlier version that this one repeats."""


class PreviewKind(StrEnum):
    """Quantity shown by a preview image."""

    INTERVAL = "interval"
    """Rate from the intervals between spikes: the least noise for a short window."""
    RATE = "rate"
    """Spike counts of a short window."""
    ACCUMULATION = "accumulation"
    """Spike counts, averaged over about the last second."""


class PreviewTaken(BaseModel):
    """Preview images of the newest frames."""

    type: Literal["preview"] = "preview"
    frame: int
    """Ring index of the middle frame."""
    width: int
    height: int
    white: dict[PreviewKind, float]
    """Rate shown as white, spikes a frame."""
    images: dict[PreviewKind, str]
    """WebP, base64."""
    rate_histogram: list[int]
    """Pixels by rate, in equal bins from 0 to 1 spike a frame."""
    counts: str
    """Spikes of the pixels, a PNG of 8 or 16 bits, base64."""
    counted: int
    """Frames in which they were counted."""


class Logged(BaseModel):
    """A line of the worker's log."""

    type: Literal["log"] = "log"
    level: str
    event: str
    logger: str
    known: dict[str, str]
    """Role, capture id and reconstruction id."""


class UploadConverts(BaseModel):
    """The uploaded file is about to be converted to a recording of at most so many bytes."""

    type: Literal["upload_converts"] = "upload_converts"
    bytes: int


class UploadChecked(BaseModel):
    """Result of the check of an uploaded recording."""

    type: Literal["upload_checked"] = "upload_checked"
    converted: bool
    """Whether the recording is `UploadCommand.converted`, not the uploaded file."""
    sensor: Sensor
    frames: int
    bytes: int
    lost: dict[str, int]
    """Frames in the gaps that its sidecar lists, by cause."""
    sha256: str
    grade: str
    """Grade as `spiked verify` gives it."""
    reasons: tuple[str, ...]
    warnings: tuple[str, ...] = ()
    """What nothing states of the camera, and what the pixels contradict."""


class WorkerError(BaseModel):
    """The command failed for a reason that the user can correct."""

    type: Literal["error"] = "error"
    reason: str
    disk_full: bool = False
    """Whether there was no room on the disk."""


WorkerEvent = Annotated[
    RingOpened
    | Warned
    | RecordingFailed
    | RecordingEnded
    | NodeFound
    | NotBegun
    | ReconstructionStatus
    | PoseEstimated
    | FramesSkipped
    | PlaceCompared
    | VersionPublished
    | PreviewTaken
    | Logged
    | UploadConverts
    | UploadChecked
    | WorkerError,
    Field(discriminator="type"),
]
commands: TypeAdapter[Command] = TypeAdapter(Command)
worker_events: TypeAdapter[WorkerEvent] = TypeAdapter(WorkerEvent)
