"""Row types of the catalogue."""

from copy import copy
from dataclasses import dataclass, field
from datetime import datetime
from enum import StrEnum
from typing import Annotated, TypedDict

from pydantic import AliasChoices, Field

from spiked.recon import State
from spiked.ring import DeviceState, Policy, RingStatus
from spiked.sensor import Intrinsics, Sensor
from spiked_service.settings.reconstruction_options import ReconstructionOptions


class Stage(StrEnum):
    """The phase of a reconstruction."""

    WAITING = "waiting"
    TRACKING = "tracking"
    MAPPING = "mapping"
    REFINING = "refining"
    JOINING = "joining"
    """Two maps become one."""
    DONE = "done"


class Task(StrEnum):
    """What a job in the queue of reconstructions does."""

    RECONSTRUCT = "reconstruct"
    EXTEND = "extend"
    """Reconstruct a recording and join it with a map."""
    MERGE = "merge"
    """Make one map of two, without recordings."""
    LOCALISE = "localise"
    """Find where the camera of a recording was in a map."""

    @property
    def reads_recording(self) -> bool:
        """Whether it needs the recording of its capture."""
        return self is not Task.MERGE

    @property
    def reconstructs(self) -> bool:
        """Whether it tracks and maps a recording."""
        return self in (Task.RECONSTRUCT, Task.EXTEND)


class Origin(StrEnum):
    """Where a recording comes from."""

    LIVE = "live"
    UPLOAD = "upload"
    RECOVERED = "recovered"
    """Found in the data folder without a row, which was rebuilt from its files."""


class CaptureState(StrEnum):
    """State of a capture."""

    STARTING = "starting"
    """No frame has been received yet."""
    WAITING = "waiting"
    """The camera is absent or sends nothing; the capture continues when it sends frames."""
    STREAMING = "streaming"
    """Frames are received."""
    FINISHING = "finishing"
    """The source has ended; the recording is being closed, and the reconstruction is being refined."""
    COMPLETE = "complete"
    FAILED = "failed"
    """See the reason. Recording and published versions are kept."""

    @property
    def acquiring(self) -> bool:
        """Whether frames are received, or awaited."""
        return self in (CaptureState.STARTING, CaptureState.WAITING, CaptureState.STREAMING)

    @property
    def over(self) -> bool:
        """Whether the capture has ended; its state does not change any more."""
        return self in (CaptureState.COMPLETE, CaptureState.FAILED)


class JobState(StrEnum):
    """State of a reconstruction."""

    QUEUED = "queued"
    RUNNING = "running"
    COMPLETE = "complete"
    CANCELLED = "cancelled"
    """Cancelled by a user. Published versions are kept."""
    FAILED = "failed"

    @property
    def over(self) -> bool:
        """Whether the reconstruction has ended; it can be restarted."""
        return self not in (JobState.QUEUED, JobState.RUNNING)


class Grade(StrEnum):
    """Quality of a recording, as `spiked verify` prints it."""

    GOOD = "good"
    DEGRADED = "degraded"
    BAD = "bad"


@dataclass(frozen=True)
class Quality:
    """The verdict on a recording."""

    grade: Grade
    reasons: tuple[str, ...] = ()
    """Reasons for a grade below good, the worst first."""


@dataclass(frozen=True)
class Recorded:
    """The recording of a capture on disk."""

    frames: int
    bytes: int
    """Size of the `.dat` file."""
    first_frame: int = 0
    """Index in the capture of the first frame recorded."""
    lost: int = 0
    """Frames missing between its first and the end of the capture."""
    lost_by_cause: dict[str, int] = field(default_factory=dict)
    """The same by cause: device, usb, ring or disk."""
    sha256: str | None = None
    """SHA-256 of the `.dat` in hex, if computed."""


@dataclass(frozen=True)
class ConsumerCounters:
    """One reader of a ring."""

    name: str
    policy: Policy
    frames_read: Annotated[int, Field(validation_alias=AliasChoices("frames_read", "received"))]
    """Called `received` in rows of 0.1."""
    lost: int
    lag_frames: int
    fill: float
    lagging: bool


@dataclass(frozen=True)
class Counters:
    """Frames of a capture."""

    device: DeviceState
    device_reason: str
    received: int
    lost: dict[str, int]
    """Lost frames by cause."""
    next_frame: int
    """Index of the next frame: that of the capture's first frame, which is 0 unless a device was armed, and frames
    received and lost."""
    consumers: tuple[ConsumerCounters, ...]

    @classmethod
    def of(cls, status: RingStatus) -> "Counters":
        """Counters of a ring now."""
        writer = status.writer
        return cls(
            writer.device_status.state,
            writer.device_status.reason,
            writer.committed,
            {str(cause): count for cause, count in writer.lost.items()},
            writer.next_frame,
            tuple(
                ConsumerCounters(
                    reader.consumer,
                    reader.policy,
                    reader.frames_read,
                    reader.lost,
                    reader.lag_frames,
                    reader.fill,
                    reader.lagging,
                )
                for reader in status.readers
            ),
        )


@dataclass(frozen=True)
class Plan:
    """Source of a capture and how it is processed."""

    source: str
    frames: int | None = None
    """None: until the source ends or the capture is stopped."""
    seconds: float | None = None
    """Alternative to `frames`."""
    pretrigger_s: float = 0.0
    """Start this long before now, from the ring of an armed device."""
    name: str = ""
    notes: str = ""
    record: bool = True
    reconstruct: bool = True
    options: ReconstructionOptions = field(default_factory=ReconstructionOptions)
    intrinsics: Intrinsics | None = None
    """None: those of the source."""


@dataclass(frozen=True)
class CaptureRow:
    """A capture or an uploaded recording."""

    id: str
    origin: Origin
    plan: Plan
    state: CaptureState
    started_at: datetime
    name: str = ""
    notes: str = ""
    keep: bool = False
    """Exempt from retention."""
    reason: str = ""
    warnings: tuple[str, ...] = ()
    sensor: Sensor | None = None
    """None until the source is open; with the plan's intrinsics if it has any."""
    frames_planned: int | None = None
    """Length of the capture, if known."""
    recording: Recorded | None = None
    verdict: Quality | None = None
    counters: Counters | None = None
    """Counters at the end."""
    ended_at: datetime | None = None
    deleted_at: datetime | None = None
    """Can be restored until retention purges it."""
    group: str | None = None
    """Id of the group of captures that were started together."""
    tags: tuple[str, ...] = ()
    """Words to find it by, in the order in which they were given."""
    metadata: dict[str, str] = field(default_factory=dict)
    """What other programs note of it, by key."""

    @property
    def source(self) -> str:
        """Source of the capture."""
        return self.plan.source


class CaptureEdit(TypedDict, total=False):
    """What a user changes of a capture; None leaves it."""

    name: str | None
    notes: str | None
    keep: bool | None
    tags: tuple[str, ...] | None
    metadata: dict[str, str] | None


@dataclass(frozen=True)
class MapRef:
    """A version of a reconstruction that a job uses as a map."""

    reconstruction_id: str
    version: int = 0


@dataclass(frozen=True)
class FrameRange:
    """Frames `first` to `first + count - 1` of a capture, by absolute index."""

    first: int
    count: int


@dataclass(frozen=True)
class ReconstructionRow:
    """A job of a capture: a reconstruction, live from its ring or from its recording, or another `Task`."""

    id: str
    capture_id: str
    live: bool
    state: JobState
    created_at: datetime
    options: ReconstructionOptions = field(default_factory=ReconstructionOptions)
    priority: int = 0
    """Higher values run first, equal ones in the order of their turns."""
    stage: Stage = Stage.WAITING
    progress: float = 0.0
    """Progress of the refinement, 0 to 1."""
    tracking_state: State = State.BOOT
    reason: str = ""
    """Why it failed, waits or is degraded."""
    attempts: int = 0
    """Number of attempts."""
    frames: int = 0
    poses: int = 0
    splats: int = 0
    loss: float | None = None
    psnr_db: float | None = None
    version: int = 0
    """Newest version published; 0: none yet."""
    white: float | None = None
    """Radiance shown as white in that version."""
    queue_place: int | None = None
    """Place in the queue, 1 is the next; None unless queued. Computed on reading."""
    eta_s: float | None = None
    """Seconds to completion, waiting time included; None if unknown."""
    started_at: datetime | None = None
    ended_at: datetime | None = None
    task: Task = Task.RECONSTRUCT
    maps: tuple[MapRef, ...] = ()
    """One, of a merge two; the result is in the frame of reference of the first."""
    part: FrameRange | None = None
    """Frames to localise; None: all."""
    recognised: bool | None = None
    """Whether all show one place; None before that is known, and without maps."""
    warnings: tuple[str, ...] = ()
    """What it found out or had to assume, one sentence each."""
    name: str = ""
    notes: str = ""
    held: bool = False
    """Stays in the queue until it is let go."""
    poses_from: str = ""
    """Where its poses are from, if they are given: a reconstruction's id, or `file`; they lie in its folder."""
    calibration_from: str = ""
    """Device whose calibration is used instead of that of the recording; it lies in its folder."""
    turn: str = ""
    """Its turn among queued ones of its priority; empty: its id."""
    user: str = ""
    """Name of the token with which it was queued; empty if none was needed."""
    attempt: str = ""
    """Id of the attempt that runs on another machine, whose token is worth nothing once this has changed."""
    node: str = ""
    """The machine that runs it or ran it last; empty: that of the service."""


def placed(row: ReconstructionRow, place: int | None, eta_s: float | None) -> ReconstructionRow:
    """The row with a place in the queue and the seconds to its completion.

    Equals `dataclasses.replace`, which takes 14 us for so many fields, at a tenth of the time: pages have 100 rows.
    """
    changed = copy(row)
    changed.__dict__.update(queue_place=place, eta_s=eta_s)
    return changed


class ReconstructionEdit(TypedDict, total=False):
    """What a user changes of a reconstruction; None leaves it."""

    name: str | None
    notes: str | None
    held: bool | None
    queue_place: int | None
    """Place in the queue, from 1; beyond its end: the last."""


@dataclass(frozen=True)
class UploadRow:
    """An upload of a recording."""

    id: str
    name: str
    bytes: int
    """Announced size."""
    created_at: datetime
    updated_at: datetime
    offset_bytes: int = 0
    """Bytes received and synced to disk."""
    sidecar: str | None = None
    """The text of its sidecar, as sent."""
    geometry: str | None = None
    """Stated geometry and notes, as JSON."""
    sha256: str | None = None
    """Announced SHA-256."""
    capture_id: str | None = None
    """Id of its capture, once complete."""


@dataclass(frozen=True)
class VersionRow:
    """A published version of a scene and its trajectory."""

    reconstruction_id: str
    version: int
    at: datetime
    splats: int
    poses: int
    white: float
    scene_bytes: int
    psnr_db: float | None = None
