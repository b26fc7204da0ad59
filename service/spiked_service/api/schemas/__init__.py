"""What goes over HTTP, with an example of each."""

from spiked_service.api.schemas.base import IntrinsicsModel, PageOut
from spiked_service.api.schemas.captures import (
    ArmRequest,
    CaptureChange,
    CaptureOut,
    CaptureRequest,
    CountersOut,
    DeviceOut,
    DevicesOut,
    StatsOut,
    VerdictOut,
)
from spiked_service.api.schemas.reconstructions import (
    ReconstructionChange,
    ReconstructionOut,
    ReconstructionRequest,
    RestartRequest,
    TimelineOut,
    TrajectoryOut,
    VersionOut,
    VersionsOut,
)
from spiked_service.api.schemas.uploads import UploadOut, UploadRequest
from spiked_service.api.schemas.views import CameraModel, PathModel, ViewRequest

__all__ = [
    "ArmRequest",
    "CameraModel",
    "CaptureChange",
    "CaptureOut",
    "CaptureRequest",
    "CountersOut",
    "DeviceOut",
    "DevicesOut",
    "IntrinsicsModel",
    "PageOut",
    "PathModel",
    "ReconstructionChange",
    "ReconstructionOut",
    "ReconstructionRequest",
    "RestartRequest",
    "StatsOut",
    "TimelineOut",
    "TrajectoryOut",
    "UploadOut",
    "UploadRequest",
    "VerdictOut",
    "VersionOut",
    "VersionsOut",
    "ViewRequest",
]
