"""What only events carry: poses, scene versions, pictures, log lines, and what was lost."""

import base64
from enum import StrEnum
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, PlainSerializer

Picture = Annotated[bytes, PlainSerializer(lambda image: base64.b64encode(image).decode(), str, when_used="json")]
"""An encoded picture: base64 in JSON, plain bytes in msgpack."""


class _Payload(BaseModel):
    model_config = ConfigDict(frozen=True)


class PosePayload(_Payload):
    """The camera at one tracked block of frames; camera-to-world, OpenCV axes."""

    frame: int = Field(description="Absolute index of the frame in the middle of the block.")
    time_s: float = Field(description="Middle of that frame, seconds since the start of the capture.")
    position: tuple[float, float, float] = Field(description="Centre of the camera, length unit of the scene.")
    quaternion_wxyz: tuple[float, float, float, float]
    state: str = Field(description="State of the tracking: boot, track, degraded, lost or reloc.")
    sigma_px: float | None = Field(None, description="One standard deviation of the pose in the image, pixels.")
    chi2: float | None = Field(None, description="Squared residual in units of its variance; 1 is as expected.")
    latency_s: float | None = Field(None, description="From the last frame's arrival in the ring to this message.")


class ScenePayload(_Payload):
    """A new version of a scene can be fetched."""

    version: int
    splats: int
    psnr_db: float | None = None
    bytes: int = Field(description="Size of the PLY file.")


class PreviewPayload(_Payload):
    """A picture of the newest frames, WebP."""

    frame: int = Field(description="Absolute index of the frame in the middle of the window shown.")
    kind: Literal["interval", "rate"]
    width: int
    height: int
    image: Picture
    rate_histogram: list[int] | None = None


class LogPayload(BaseModel):
    """A line of the log; what else it says are further fields."""

    model_config = ConfigDict(extra="allow", frozen=True)

    level: str
    event: str
    logger: str


class Why(StrEnum):
    """Why messages were lost."""

    SLOW = "slow"
    """The subscriber did not take them in time."""
    FORGOTTEN = "forgotten"
    """`since` lies further back than the service remembers."""
    RESTARTED = "restarted"
    """`since` is from an earlier run of the service, whose numbers began anew."""


class LostPayload(_Payload):
    """Messages that this subscriber asked for and does not get."""

    why: Why
    messages: int | None = Field(description="How many; null after a restart.")
    by_topic: dict[str, int] = Field(description="How many of each topic, where that is known.")
    first_seq: int | None = Field(description="Number of the first of them.")
    last_seq: int | None = Field(description="Number of the last of them; others between may have been delivered.")
