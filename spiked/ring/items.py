"""What travels through a ring: losses, ends, states, and the policies by which consumers take them."""

from dataclasses import dataclass
from enum import StrEnum
from typing import TypeVar

from spiked.errors import SpikedError


class RingError(SpikedError):
    """A ring cannot be created, attached to or used as asked."""


class Cause(StrEnum):
    """Where frames were lost."""

    DEVICE = "device"
    """The camera did not send them, or was away."""
    USB = "usb"
    """They were lost between the camera and this process."""
    RING = "ring"
    """They were overwritten before this consumer took them, or it chose to skip them."""
    DISK = "disk"
    """They could not be written, or not be read back."""


class Policy(StrEnum):
    """What a consumer that falls behind wants. The writer waits for none of them."""

    LOSSLESS = "lossless"
    """Every frame while it stays within half of the ring; then a gap, and it is marked lagging."""
    PRIORITY = "priority"
    """As lossless, with seven eighths of the ring: for the recorder."""
    LATEST = "latest"
    """The newest block, told how many frames were skipped."""


class EndReason(StrEnum):
    """Why a capture ended."""

    FINISHED = "finished"
    """The source has no more frames, or as many as asked for were taken."""
    STOPPED = "stopped"
    """Somebody asked for it."""
    FAILED = "failed"
    """The source or the acquisition failed; the device condition says how."""
    WRITER_DIED = "writer_died"
    """The acquisition process ended without a word."""


class DeviceState(StrEnum):
    """Where the camera of a capture stands: absent -> idle -> armed -> streaming -> lost -> absent."""

    ABSENT = "absent"
    IDLE = "idle"
    ARMED = "armed"
    STREAMING = "streaming"
    LOST = "lost"


@dataclass(frozen=True)
class Condition:
    """A device state and, in a few words, why it is so."""

    state: DeviceState
    reason: str = ""


@dataclass(frozen=True)
class Gap:
    """Frames `first` to `first + count - 1` of the capture are lost."""

    first: int
    count: int
    cause: Cause

    def __post_init__(self) -> None:
        if self.first < 0 or self.count <= 0:
            raise RingError(f"a gap of {self.count} frames from frame {self.first} is not possible")


@dataclass(frozen=True)
class End:
    """The capture is over after `frames` frames, received and lost together."""

    frames: int
    reason: EndReason


_Code = TypeVar("_Code", bound=StrEnum)


def encode(value: StrEnum) -> int:
    """The number by which shared memory knows a member of an enum: 1 for the first; 0 stays free for "none"."""
    return list(type(value)).index(value) + 1


def decode(kind: type[_Code], code: int) -> _Code:
    """The member that `encode` gave this number."""
    return list(kind)[code - 1]
