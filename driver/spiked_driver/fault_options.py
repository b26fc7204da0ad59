"""Faults as options of a source's text, and the same as flags: `gap=8000:40ms`, `--unplug-at 5000:2s`."""

import math
import re
from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, field_validator

from spiked.ring import Cause
from spiked_driver.faults import Faults, Loss, Stall

_SPAN = re.compile(r"(\d+(?:\.\d+)?)(s|ms)?")


@dataclass(frozen=True)
class Span:
    """A number of frames, given as such or as a time."""

    frames: int | None
    seconds: float = 0.0

    @classmethod
    def parse(cls, text: str) -> "Span":
        """From `300`, `15ms` or `0.5s`. Raises ValueError."""
        found = _SPAN.fullmatch(text)
        if found is None or (found[2] is None and "." in text):
            raise ValueError(f"{text!r} is neither a number of frames nor a time such as 40ms or 2s")
        if found[2] is None:
            return cls(int(text))
        return cls(None, float(found[1]) * (1e-3 if found[2] == "ms" else 1.0))

    def at(self, rate_hz: float) -> int:
        """In frames; a time is at least one."""
        return self.frames if self.frames is not None else max(1, math.ceil(self.seconds * rate_hz))


class FaultOptions(BaseModel):
    """What shall go wrong with a source. Each list may be given any number of times."""

    model_config = ConfigDict(frozen=True, extra="forbid", arbitrary_types_allowed=True)

    drop: float = Field(0.0, ge=0, lt=1)
    """Fraction of the frames lost at random, as if the host were too slow."""
    drop_run: int = Field(1, ge=1)
    """Frames lost each time."""
    gap: tuple[tuple[int, Span, Cause], ...] = ()
    """`FIRST:LENGTH` or `FIRST:LENGTH:CAUSE`: frames to lose; the length in frames, or as `40ms` or `2s`."""
    corrupt: float = Field(0.0, ge=0, le=1)
    """Fraction of the frames delivered with noise in some pixels."""
    unplug_at: tuple[tuple[int, Span], ...] = ()
    """`FRAME:LENGTH`: the camera is pulled out, and is back after so many frames or so long."""
    stall: tuple[tuple[int, float], ...] = ()
    """`FRAME:SECONDS`: nothing comes for a while."""
    fault_seed: int = 0
    """Of whatever is random here."""

    @field_validator("gap", mode="before")
    @classmethod
    def _gaps(cls, values: Any) -> Any:
        return [(*_first_and_length(text, 3), *(text.split(":")[2:] or [Cause.USB])) for text in many(values)]

    @field_validator("unplug_at", mode="before")
    @classmethod
    def _unplugged(cls, values: Any) -> Any:
        return [_first_and_length(text, 2) for text in many(values)]

    @field_validator("stall", mode="before")
    @classmethod
    def _stalls(cls, values: Any) -> Any:
        stalls = []
        for text in many(values):
            frame, _, length = text.partition(":")
            seconds = Span.parse(length).seconds if length.endswith("ms") else length.removesuffix("s")
            stalls.append((frame, seconds))
        return stalls

    def faults(self, rate_hz: float) -> Faults:
        """The faults, for a source of so many frames a second. Raises ConfigurationError if they do not go together."""
        losses = [Loss(first, length.at(rate_hz), cause) for first, length, cause in self.gap]
        losses += [Loss(first, length.at(rate_hz), Cause.DEVICE, unplugged=True) for first, length in self.unplug_at]
        stalls = tuple(Stall(*stall) for stall in self.stall)
        return Faults(tuple(losses), stalls, self.drop, self.drop_run, self.fault_seed, self.corrupt)


def many(values: Any) -> list[str]:
    """An option that may be given more than once, as a list."""
    return [values] if isinstance(values, str) else list(values)


def _first_and_length(text: str, most: int) -> tuple[str, Span]:
    parts = text.split(":")
    if not 2 <= len(parts) <= most:
        raise ValueError(f"{text!r} is not FIRST:LENGTH" + (" or FIRST:LENGTH:CAUSE" if most == 3 else ""))
    return parts[0], Span.parse(parts[1])
