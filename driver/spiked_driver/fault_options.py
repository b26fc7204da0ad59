"""Fault injection as options of a source's text (`gap=8000:40ms`) and as flags (`--unplug-at 5000:2s`)."""

import math
import re
from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, WithJsonSchema, field_validator

from spiked.ring import LossCause
from spiked_driver.faults import Faults, Loss, Stall

MOST_FRAMES = 10**12
"""Upper bound of frame indices and counts: a year and a half at 20 kHz."""
_MOST_FAULTS = 1000
"""Most faults of a kind in one source."""
_MOST_STALL_S = 3600.0
"""Longest stall, seconds."""
_SPAN = re.compile(r"(\d{1,12}(?:\.\d{1,9})?)(s|ms)?")
_Frame = Annotated[int, Field(ge=0, le=MOST_FRAMES)]


_TEXTS = WithJsonSchema({"type": "array", "items": {"type": "string"}, "maxItems": _MOST_FAULTS, "default": []})
"""JSON schema of an option that may be repeated."""


@dataclass(frozen=True)
class Span:
    """A number of frames, stated directly or as a time."""

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
        """Number of frames; a time is at least one frame."""
        return self.frames if self.frames is not None else max(1, min(MOST_FRAMES, math.ceil(self.seconds * rate_hz)))


class FaultOptions(BaseModel):
    """Faults to inject into a source. Options with a list may be repeated."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True)

    drop: float = Field(0.0, ge=0, lt=1)
    """Fraction of the frames lost at random, with cause usb."""
    drop_run: int = Field(1, ge=1, le=10**6)
    """Frames per random loss."""
    gap: Annotated[tuple[tuple[_Frame, Span, LossCause], ...], _TEXTS] = Field((), max_length=_MOST_FAULTS)
    """`FIRST:LENGTH` or `FIRST:LENGTH:CAUSE`: frames to lose; LENGTH in frames, or as `40ms` or `2s`."""
    corrupt: float = Field(0.0, ge=0, le=1)
    """Fraction of the frames delivered with noise in some pixels."""
    unplug_at: Annotated[tuple[tuple[_Frame, Span], ...], _TEXTS] = Field((), max_length=_MOST_FAULTS)
    """`FRAME:LENGTH`: the camera is unplugged for this number of frames or this time."""
    stall: Annotated[tuple[tuple[_Frame, Annotated[float, Field(ge=0, le=_MOST_STALL_S)]], ...], _TEXTS] = Field(
        (), max_length=_MOST_FAULTS
    )
    """`FRAME:SECONDS`: no frames come for this time; none is lost."""
    fault_seed: int = Field(0, ge=0, lt=1 << 32)
    """Seed of random losses and of noise."""

    @field_validator("gap", mode="before")
    @classmethod
    def _gaps(cls, values: Any) -> Any:
        return [(*_first_and_length(text, 3), *(text.split(":")[2:] or [LossCause.USB])) for text in many(values)]

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
        """The faults for a source of `rate_hz` frames a second. Raises ConfigurationError if losses overlap."""
        losses = [Loss(first, length.at(rate_hz), cause) for first, length, cause in self.gap]
        losses += [
            Loss(first, length.at(rate_hz), LossCause.DEVICE, unplugged=True) for first, length in self.unplug_at
        ]
        stalls = tuple(Stall(*stall) for stall in self.stall)
        return Faults(tuple(losses), stalls, self.drop, self.drop_run, self.fault_seed, self.corrupt)


def many(values: Any) -> list[str]:
    """The values of an option that may be repeated, as a list."""
    return [values] if isinstance(values, str) else list(values)


def _first_and_length(text: str, most: int) -> tuple[str, Span]:
    parts = text.split(":")
    if not 2 <= len(parts) <= most:
        raise ValueError(f"{text!r} is not FIRST:LENGTH" + (" or FIRST:LENGTH:CAUSE" if most == 3 else ""))
    return parts[0], Span.parse(parts[1])
