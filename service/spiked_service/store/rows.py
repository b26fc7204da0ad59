"""What the catalogue remembers, row by row."""

from dataclasses import dataclass, field
from datetime import datetime
from enum import StrEnum

from spiked.recon import State
from spiked.ring import DeviceState, Policy, RingStatus
from spiked.sensor import Intrinsics, Sensor
from spiked_service.messages import Stage
from spiked_service.reconstruction_options import ReconstructionOptions


class Origin(StrEnum):
    """Where a recording comes from."""

    LIVE = "live"
    UPLOAD = "upload"


class CaptureState(StrEnum):
    """Where a capture stands."""

    STARTING = "starting"
    STREAMING = "streaming"
    FINISHING = "finishing"
    """The source has ended; the recording is closed, and the reconstruction refines what it has."""
    COMPLETE = "complete"
    FAILED = "failed"
    """Something died or was refused, the reason says what; what was recorded and published stays available."""

    @property
    def over(self) -> bool:
        """Whether nothing more will happen."""
        return self in (CaptureState.COMPLETE, CaptureState.FAILED)


class JobState(StrEnum):
    """Where a reconstruction stands."""

    QUEUED = "queued"
    RUNNING = "running"
    COMPLETE = "complete"
    CANCELLED = "cancelled"
    """Somebody asked for it; what was published stays available."""
    FAILED = "failed"

    @property
    def over(self) -> bool:
        """Whether nothing more will happen unless it is restarted."""
        return self not in (JobState.QUEUED, JobState.RUNNING)


class Grade(StrEnum):
    """What a recording is good for, as `spiked verify` says it."""

    GOOD = "good"
    DEGRADED = "degraded"
    BAD = "bad"


@dataclass(frozen=True)
class Judgement:
    """The verdict on a recording."""

    grade: Grade
    reasons: tuple[str, ...] = ()
    """Why it is not good, the worst first."""


@dataclass(frozen=True)
class Recorded:
    """What lies on disk of a capture."""

    frames: int
    bytes: int
    """Of the `.dat` alone."""
    first_frame: int = 0
    """Index in the capture of the first frame recorded."""
    lost: int = 0
    """Frames missing between its first and its last."""
    sha256: str | None = None
    """Of the `.dat`, in hex, where it was computed."""


@dataclass(frozen=True)
class ConsumerCounters:
    """One reader of a ring."""

    name: str
    policy: Policy
    received: int
    lost: int
    lag_frames: int
    fill: float
    lagging: bool


@dataclass(frozen=True)
class Counters:
    """Frames of a capture; received and lost together are the index of the next frame."""

    device: DeviceState
    device_reason: str
    received: int
    lost: dict[str, int]
    """By cause."""
    next_frame: int
    consumers: tuple[ConsumerCounters, ...]

    @classmethod
    def of(cls, status: RingStatus) -> "Counters":
        """Of a ring at one moment."""
        writer = status.writer
        return cls(
            writer.condition.state,
            writer.condition.reason,
            writer.committed,
            {str(cause): count for cause, count in writer.lost.items()},
            writer.next_frame,
            tuple(
                ConsumerCounters(
                    reader.consumer,
                    reader.policy,
                    reader.received,
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
    """What to capture, and what to do with it."""

    source: str
    frames: int | None = None
    """None: until the source ends or the capture is stopped."""
    seconds: float | None = None
    """Instead of frames."""
    pretrigger_s: float = 0.0
    """Begin so long before now, with what the ring of an armed device still holds."""
    name: str = ""
    notes: str = ""
    record: bool = True
    reconstruct: bool = True
    options: ReconstructionOptions = field(default_factory=ReconstructionOptions)
    intrinsics: Intrinsics | None = None
    """None: the source's own."""


@dataclass(frozen=True)
class CaptureRow:
    """A capture, or an uploaded recording, which is one that took place elsewhere."""

    id: str
    origin: Origin
    plan: Plan
    state: CaptureState
    started_at: datetime
    name: str = ""
    notes: str = ""
    keep: bool = False
    """Retention leaves it alone."""
    reason: str = ""
    warnings: tuple[str, ...] = ()
    sensor: Sensor | None = None
    """None until the source is open; with the plan's intrinsics if it has any."""
    frames_planned: int | None = None
    """Length of the capture if it is known."""
    recording: Recorded | None = None
    verdict: Judgement | None = None
    counters: Counters | None = None
    """As they were at the end."""
    ended_at: datetime | None = None
    deleted_at: datetime | None = None
    """It can be restored until retention removes it for good."""

    @property
    def source(self) -> str:
        """What it was captured from."""
        return self.plan.source


@dataclass(frozen=True)
class ReconstructionRow:
    """A reconstruction of a capture: live from its ring, or from its recording."""

    id: str
    capture_id: str
    live: bool
    state: JobState
    created_at: datetime
    options: ReconstructionOptions = field(default_factory=ReconstructionOptions)
    priority: int = 0
    """Higher ones run earlier; equal ones in the order of their ids."""
    stage: Stage = Stage.WAITING
    progress: float = 0.0
    """0 to 1."""
    tracking_state: State = State.BOOT
    reason: str = ""
    """Why it failed, waits or tracks badly."""
    attempts: int = 0
    """How often it was begun."""
    frames: int = 0
    poses: int = 0
    splats: int = 0
    loss: float | None = None
    psnr_db: float | None = None
    version: int = 0
    """Newest version published; 0: none yet."""
    white: float | None = None
    """Radiance to be shown as white in that version."""
    eta_s: float | None = None
    started_at: datetime | None = None
    ended_at: datetime | None = None


@dataclass(frozen=True)
class UploadRow:
    """A recording on its way here."""

    id: str
    name: str
    bytes: int
    """What it will be."""
    created_at: datetime
    updated_at: datetime
    offset_bytes: int = 0
    """What has come, and is on disk."""
    sidecar: str | None = None
    """The text of its sidecar, as sent."""
    geometry: str | None = None
    """What was said about its geometry, as JSON."""
    sha256: str | None = None
    """What it shall be."""
    capture_id: str | None = None
    """What it became."""


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
