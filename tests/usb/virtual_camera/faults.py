"""What the camera does wrong, and when."""

from dataclasses import dataclass
from enum import StrEnum


class Kind(StrEnum):
    """A way to misbehave."""

    DROP = "drop"
    """`count` frames are not sent; the counters go on."""
    REPEAT = "repeat"
    """The frame before is sent again, `count` times."""
    FLIP = "flip"
    """The byte at `offset` of the frame is changed by XOR with `count`."""
    LOSE = "lose"
    """`count` bytes from `offset` on vanish on the way."""
    JUNK = "junk"
    """`count` bytes that mean nothing come before the frame."""
    CUT = "cut"
    """The transfer ends short at `offset` of the frame; nothing is lost."""
    STALL = "stall"
    """The endpoint halts (EPIPE) until the host clears it."""
    BABBLE = "babble"
    """A transfer fails with EOVERFLOW, having the bytes that came before."""
    SILENCE = "silence"
    """Nothing is sent for `seconds`; frames go by meanwhile, as far as there is a clock."""
    UNPLUG = "unplug"
    """The camera is pulled out, and comes back after `seconds`, if that is not 0, on `port` or where it was."""
    RESTART = "restart"
    """The camera starts anew without leaving the bus: its counters begin at other values."""


@dataclass(frozen=True, order=True)
class Fault:
    """Something that happens before the camera's frame `frame`, or within it."""

    frame: int
    kind: Kind
    offset: int = 0
    count: int = 1
    seconds: float = 0.0
    port: str | None = None
