"""What the service and an agent tell each other about an attempt."""

from enum import StrEnum
from pathlib import PurePosixPath
from typing import Annotated

from pydantic import AfterValidator, BaseModel, Field

from spiked_service.workers.messages import Command, WorkerEvent

LARGEST_FILE = 1 << 50
"""Bytes; larger sizes are a mistake."""


class Order(StrEnum):
    """What an agent is to do with its worker."""

    GO_ON = "go_on"
    STOP = "stop"
    """Finish the work and exit, which may take a while."""
    LEAVE = "leave"
    """Exit within the time of grace, then be killed."""


def _within(name: str) -> str:
    """A path below a folder. Raises ValueError for any other, which would be written elsewhere."""
    path = PurePosixPath(name)
    if path.is_absolute() or not path.parts or any(part.startswith(".") for part in path.parts) or "\\" in name:
        raise ValueError("should be a path below the folder of the job")
    return name


class StoredFile(BaseModel):
    """A file of a job and where its content is."""

    name: Annotated[str, AfterValidator(_within), Field(max_length=255)]
    """Path below its folder."""
    bytes: Annotated[int, Field(ge=0, le=LARGEST_FILE)]
    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class Inputs(BaseModel):
    """What an attempt begins with."""

    recording: list[StoredFile]
    """Files of the folder of its capture, each the object SHA256 of `recordings`."""
    folder: list[StoredFile]
    """Files of the folder of the job: earlier versions, maps, what was given. Each is `inputs/SHA256` of `store`."""
    in_place: bool
    """Whether the recording is read where the command has it: service and agents share a file system."""


class AttemptWork(BaseModel):
    """The answer to an agent that begins."""

    command: Command
    """With the paths of the service."""
    inputs: Inputs
    store: str
    """URI of the folder of the attempt in the object store."""
    recordings: str
    """URI of the folder of the recordings there."""
    cache_bytes: Annotated[int, Field(ge=0)]
    """Bytes of recordings that a machine keeps for other attempts."""
    lease_s: float
    """An agent that has not been answered for so long ends its worker: another attempt begins."""
    report_s: float
    """Interval of reports, which also renew the lease."""
    grace_s: float
    """Time from the order to leave to the kill."""


class Begin(BaseModel):
    """An agent takes an attempt."""

    agent: Annotated[str, Field(min_length=1, max_length=64)]
    """Made up by the agent: a repeated request is answered, another agent is refused."""
    node: Annotated[str, Field(max_length=255)]
    """Name of its machine."""


class Report(BaseModel):
    """What has happened since the last report, maybe nothing."""

    agent: Annotated[str, Field(min_length=1, max_length=64)]
    sequence: Annotated[int, Field(ge=0, le=1 << 53)] = 0
    """Counts the reports with events, from 1: one that was sent again is skipped."""
    events: list[WorkerEvent] = []
    files: list[StoredFile] | None = None
    """All files of the job's folder, where a version among the events needs them; their content is stored."""


class Next(BaseModel):
    """Another attempt for an agent whose own has ended."""

    attempt: str
    token: str


class ReportAnswer(BaseModel):
    """The answer to a report."""

    order: Order


class CheckpointCopy(BaseModel):
    """A checkpoint in the store of its attempt."""

    number: Annotated[int, Field(ge=0)]
    """Of its folder."""
    files: list[StoredFile]


class Manifest(BaseModel):
    """The end of an attempt, `manifest.json` in its store, written after all files."""

    attempt: str
    node: str
    trouble: str | None
    """Why the worker failed, as a sentence; None after success."""
    reports: int
    """Number of the last report with events. One that has not arrived is made good for by these events:"""
    events: list[WorkerEvent]
    """Those that the outcome depends on: versions, errors and the last status."""
    files: list[StoredFile]
    checkpoint: CheckpointCopy | None
    """Of a worker that has not done all of its work."""
