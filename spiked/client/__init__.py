"""A client of the daemon: `Spiked("http://127.0.0.1:8650")`. It needs nothing of the service but its address."""

from spiked.client.client import Spiked
from spiked.client.connection import ApiError, ServiceUnreachableError
from spiked.client.events import Event
from spiked.client.frames import FrameBlock, FrameStream
from spiked.client.models import (
    CalibratedOut,
    CaptureOut,
    CaptureRequest,
    CaptureState,
    GeometryModel,
    Grade,
    GroupOut,
    ImageFormat,
    IntrinsicsModel,
    JobState,
    NoiseModel,
    Output,
    Problem,
    ProfileModel,
    ReconstructionOptions,
    ReconstructionOut,
    SceneFormat,
    StatedCameraModel,
    TrajectoryFormat,
    TrajectoryOut,
)

__all__ = [
    "ApiError",
    "CalibratedOut",
    "CaptureOut",
    "CaptureRequest",
    "CaptureState",
    "Event",
    "FrameBlock",
    "FrameStream",
    "GeometryModel",
    "Grade",
    "GroupOut",
    "ImageFormat",
    "IntrinsicsModel",
    "JobState",
    "NoiseModel",
    "Output",
    "Problem",
    "ProfileModel",
    "ReconstructionOptions",
    "ReconstructionOut",
    "SceneFormat",
    "ServiceUnreachableError",
    "Spiked",
    "StatedCameraModel",
    "TrajectoryFormat",
    "TrajectoryOut",
]
