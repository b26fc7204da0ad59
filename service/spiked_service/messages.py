"""What the service and its workers say to each other: one JSON object a line, orders on stdin, news on stdout."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, Field, TypeAdapter

from spiked.recon import State
from spiked.sensor import Intrinsics


class AcquisitionOrder(BaseModel):
    """Move a source into a new ring."""

    role: Literal["acquisition"] = "acquisition"
    source: str
    ring_id: str
    frames: int | None
    seconds: float | None
    consumers: int


class ReconstructionOrder(BaseModel):
    """Reconstruct what comes through a ring, and publish it in a folder."""

    role: Literal["reconstruction"] = "reconstruction"
    ring: str
    folder: Path
    unhurried: bool
    """The source waits for its consumers, so that there is time to map between frames."""
    seed: int
    steps: int
    intrinsics: Intrinsics | None


class PreviewOrder(BaseModel):
    """Keep a picture of the newest frames of a ring in a file."""

    role: Literal["preview"] = "preview"
    ring: str
    file: Path


Order = Annotated[AcquisitionOrder | ReconstructionOrder | PreviewOrder, Field(discriminator="role")]
STOP = "stop\n"
"""The order line that asks a worker to end in good order; the end of its stdin asks it to go at once."""


class RingOpened(BaseModel):
    """Acquisition has made its ring; its consumers may attach."""

    news: Literal["ring_opened"] = "ring_opened"
    name: str
    width: int
    height: int
    frame_rate_hz: float
    frames: int | None
    intrinsics: Intrinsics | None
    unhurried: bool


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


class Refused(BaseModel):
    """A worker cannot do what it was ordered, for a reason that is the user's to mend."""

    news: Literal["refused"] = "refused"
    reason: str


News = Annotated[RingOpened | ReconstructionStatus | Refused, Field(discriminator="news")]
orders: TypeAdapter[Order] = TypeAdapter(Order)
news_lines: TypeAdapter[News] = TypeAdapter(News)
