"""Items of a ring (gaps, ends, device states, clock pairs) and the policies of its readers."""

from dataclasses import dataclass
from enum import StrEnum
from typing import TypeVar

from spiked.errors import SpikedError
from spiked.native._ring import Entry


class RingError(SpikedError):
    """A ring cannot be created, attached to or used as requested."""


class LossCause(StrEnum):
    """Where frames were lost."""

    DEVICE = "device"
    """The camera did not send them, or was away."""
    USB = "usb"
    """The host lost them between the camera and the acquisition process."""
    RING = "ring"
    """They were overwritten before this reader took them, or its policy skipped them."""
    DISK = "disk"
    """They could not be written to disk, or not be read back."""


class Policy(StrEnum):
    """How a reader is treated when it falls behind. The writer waits for none."""

    LOSSLESS = "lossless"
    """Every frame while it stays within half of the ring; beyond, a gap, and the reader is marked lagging."""
    PRIORITY = "priority"
    """As lossless, within seven eighths of the ring. For the recorder."""
    LATEST = "latest"
    """The newest block, with a gap for the frames skipped."""


class EndReason(StrEnum):
    """Why a capture ended."""

    FINISHED = "finished"
    """The source has no more frames, or the requested number was captured."""
    STOPPED = "stopped"
    """It was stopped on request."""
    FAILED = "failed"
    """The source or the acquisition failed; the device status has the reason."""
    WRITER_DIED = "writer_died"
    """The acquisition process died without ending the capture."""


class DeviceState(StrEnum):
    """State of a capture's camera: absent -> idle -> armed -> streaming -> lost -> absent."""

    ABSENT = "absent"
    IDLE = "idle"
    ARMED = "armed"
    STREAMING = "streaming"
    LOST = "lost"


@dataclass(frozen=True)
class DeviceStatus:
    """A device state and its reason."""

    state: DeviceState
    reason: str = ""


@dataclass(frozen=True)
class Gap:
    """Frames `first` to `first + count - 1` of the capture are lost."""

    first: int
    count: int
    cause: LossCause

    def __post_init__(self) -> None:
        if self.first < 0 or self.count <= 0:
            raise RingError(f"a gap of {self.count} frames from frame {self.first} is not possible")


@dataclass(frozen=True)
class End:
    """The capture has ended after `frames` frames, received and lost together."""

    frames: int
    reason: EndReason


@dataclass(frozen=True)
class ClockPair:
    """Host time at which a frame had arrived whole."""

    frame: int
    unix_ns: int


_Code = TypeVar("_Code", bound=StrEnum)


def encode(value: StrEnum) -> int:
    """Code of an enum member in shared memory: 1 for the first; 0 means "none"."""
    return list(type(value)).index(value) + 1


def decode(kind: type[_Code], code: int) -> _Code:
    """The member with this code; the inverse of `encode`."""
    return list(kind)[code - 1]


def is_clock_pair(entry: Entry) -> bool:
    """Whether an entry of the log is a clock pair: `count` is a Unix time in ns, `cause` the frame minus `first`, below
    0."""
    return bool(entry.cause < 0)
