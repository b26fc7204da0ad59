"""What the models of the API share."""

from datetime import UTC, datetime
from typing import Annotated, Any, Generic, TypeVar

from fastapi import Query
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, StrictFloat

from spiked.sensor import Intrinsics

T = TypeVar("T")

ID_EXAMPLE = "01928f5c-7e2a-7c3d-8a41-0f6d2b9c5e10"
LARGEST_INTEGER = 2**53 - 1
"""Beyond it JavaScript does not count exactly."""


class In(BaseModel):
    """What comes in: unknown fields and numbers that are not finite are refused.

    Its numbers and truth values are Pydantic's strict ones: `"1"`, `true` and `1` are three different things.
    """

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


class Out(BaseModel):
    """What goes out. Every field is always there, null where nothing is known."""

    model_config = ConfigDict(json_schema_serialization_defaults_required=True)


def example(**fields: Any) -> ConfigDict:
    """Configuration of an incoming model with a worked example."""
    return ConfigDict(extra="forbid", allow_inf_nan=False, json_schema_extra={"examples": [fields]})


def examples(*given: dict[str, Any]) -> ConfigDict:
    """Configuration of an incoming model with worked examples."""
    return ConfigDict(extra="forbid", allow_inf_nan=False, json_schema_extra={"examples": list(given)})


def _printable(text: str) -> str:
    if any((ord(letter) < 32 and letter not in "\n\t") or 0xD800 <= ord(letter) < 0xE000 for letter in text):
        raise ValueError("control characters do not belong here")
    return text


def _one_line(text: str) -> str:
    if "\n" in text or "\t" in text:
        raise ValueError("one line is expected")
    return _printable(text)


Name = Annotated[str, Field(max_length=200), AfterValidator(_one_line)]
Notes = Annotated[str, Field(max_length=20_000), AfterValidator(_printable)]
Id = Annotated[str, Field(description="UUID version 7: ids sort by time.", examples=[ID_EXAMPLE])]
Finite = Annotated[StrictFloat, Field(allow_inf_nan=False)]
Vector = tuple[Finite, Finite, Finite]
Quaternion = tuple[Finite, Finite, Finite, Finite]


Limit = Annotated[int, Query(ge=1, le=200, description="Most items of an answer.")]
Cursor = Annotated[
    str | None,
    Query(min_length=1, max_length=64, description="`next_cursor` of the page before."),
]


class PageOut(Out, Generic[T]):
    """Some of a list, newest first."""

    items: list[T]
    next_cursor: str | None = Field(
        description="To be given as `cursor` for those that follow; null: there are no more.", examples=[None]
    )


class IntrinsicsModel(In):
    """A pinhole camera; pixels, the centre of the first pixel is (0.5, 0.5)."""

    model_config = example(fx=420.0, fy=420.0, cx=200.0, cy=125.0)

    fx: StrictFloat = Field(gt=0, le=1e6)
    fy: StrictFloat = Field(gt=0, le=1e6)
    cx: StrictFloat = Field(ge=-1e6, le=1e6)
    cy: StrictFloat = Field(ge=-1e6, le=1e6)

    def intrinsics(self) -> Intrinsics:
        """The same for the library."""
        return Intrinsics(self.fx, self.fy, self.cx, self.cy)

    @classmethod
    def of(cls, intrinsics: Intrinsics | None) -> "IntrinsicsModel | None":
        """The same from the library."""
        if intrinsics is None:
            return None
        return cls(fx=intrinsics.fx, fy=intrinsics.fy, cx=intrinsics.cx, cy=intrinsics.cy)


def utc(at: datetime | None) -> datetime | None:
    """Times go out as UTC."""
    return None if at is None else at.astimezone(UTC)
