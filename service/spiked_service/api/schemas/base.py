"""What the models of the API share."""

import re
from itertools import combinations, permutations
from typing import Annotated, Any, Generic, TypeVar

from fastapi import Query
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    StrictFloat,
    StringConstraints,
    model_validator,
)

from spiked.camera import Pinhole

T = TypeVar("T")

ID_EXAMPLE = "01928f5c-7e2a-7c3d-8a41-0f6d2b9c5e10"
LARGEST_INTEGER = 2**53 - 1
"""Beyond it JavaScript does not count exactly."""


class In(BaseModel):
    """What comes in: unknown fields and numbers that are not finite are refused.

    Its numbers and truth values are Pydantic's strict ones: `"1"`, `true` and `1` are three different things.
    """

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _integers(cls, body: object) -> object:
        """To JSON Schema 20.0 is an integer."""
        return _integral(body)


class Out(BaseModel):
    """What goes out. Every field is always there, null where nothing is known."""

    model_config = ConfigDict(json_schema_serialization_defaults_required=True)


def example(**fields: Any) -> ConfigDict:
    """Configuration of an incoming model with a worked example."""
    return ConfigDict(extra="forbid", allow_inf_nan=False, json_schema_extra={"examples": [fields]})


def examples(*given: dict[str, Any], rules: list[dict[str, Any]] | None = None) -> ConfigDict:
    """Configuration of an incoming model with worked examples, and rules between its fields as JSON Schema."""
    extra: dict[str, Any] = {"examples": list(given)} | ({"allOf": rules} if rules else {})
    return ConfigDict(extra="forbid", allow_inf_nan=False, json_schema_extra=extra)


def exactly_one_of(**fields: str) -> list[dict[str, Any]]:
    """Rules: one of the fields is given, and no other; each with its type in JSON."""
    return [*at_least_one_of(*fields), *at_most_one_of(**fields)]


def at_least_one_of(*fields: str) -> list[dict[str, Any]]:
    """Rules: one of the fields is given, or several.

    All rules say what must not be: of other forms generators of clients make a type for each case.
    """
    return [_never(dict.fromkeys(fields, "null"), required=False)]


def at_most_one_of(**fields: str) -> list[dict[str, Any]]:
    """Rules: no two of the fields are given."""
    return [_never({one: fields[one], other: fields[other]}) for one, other in combinations(fields, 2)]


def together(**fields: str) -> list[dict[str, Any]]:
    """Rules: of two fields both are given, or none."""
    return [
        {"not": {"required": [one], "properties": {one: {"type": fields[one]}, other: {"type": "null"}}}}
        for one, other in permutations(fields, 2)
    ]


def _never(types: dict[str, str], *, required: bool = True) -> dict[str, Any]:
    rule: dict[str, Any] = {"properties": {name: {"type": kind} for name, kind in types.items()}}
    return {"not": {"required": list(types), **rule} if required else rule}


def not_null(schema: dict[str, Any]) -> None:
    """A parameter that may be left out, but has no null: HTTP knows none."""
    for choice in schema.pop("anyOf", []):
        if choice.get("type") != "null":
            schema.update(choice)


def _integral(body: object) -> object:
    match body:
        case float() if body.is_integer():
            return int(body)
        case dict():
            return {name: _integral(value) for name, value in body.items()}
        case list():
            return [_integral(value) for value in body]
    return body


def _printable(text: str) -> str:
    if any((ord(letter) < 32 and letter not in "\n\t") or 0xD800 <= ord(letter) < 0xE000 for letter in text):
        raise ValueError("control characters do not belong here")
    return text


def _one_line(text: str) -> str:
    if "\n" in text or "\t" in text:
        raise ValueError("one line is expected")
    return _printable(text)


def _word(text: str) -> str:
    if "," in text:
        raise ValueError("commas separate tags and are in none")
    return _one_line(text)


Name = Annotated[
    str,
    Field(max_length=200, json_schema_extra={"pattern": r"^[^\x00-\x1f]*$"}),
    AfterValidator(_one_line),
]
Notes = Annotated[
    str,
    Field(max_length=20_000, json_schema_extra={"pattern": r"^[^\x00-\x08\x0b-\x1f]*$"}),
    AfterValidator(_printable),
]
Tag = Annotated[
    str,
    Field(min_length=1, max_length=64, json_schema_extra={"pattern": r"^[^\x00-\x1f,]*$"}),
    AfterValidator(_word),
]
Tags = Annotated[list[Tag], Field(max_length=32, description="Words to find it by; each once.")]
Metadata = Annotated[
    dict[
        Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9_.:/-]{1,64}$")],
        Annotated[
            str,
            Field(max_length=500, json_schema_extra={"pattern": r"^[^\x00-\x1f]*$"}),
            AfterValidator(_one_line),
        ],
    ],
    Field(
        max_length=64,
        description="Values of other programs by key: letters, digits and `_.:/-`.",
        json_schema_extra={"additionalProperties": False},
    ),
]
Id = Annotated[str, Field(description="UUID version 7: ids sort by time.", examples=[ID_EXAMPLE])]
Finite = Annotated[StrictFloat, Field(allow_inf_nan=False)]
Vector = tuple[Finite, Finite, Finite]
Quaternion = tuple[Finite, Finite, Finite, Finite]


def _in_digits(text: object) -> object:
    """Of a query, where Pydantic also takes "0.0"."""
    if isinstance(text, str) and re.fullmatch(r"[+-]?\d+", text, re.ASCII) is None:
        raise ValueError("not an integer")
    return text


IN_DIGITS = BeforeValidator(_in_digits)
"""An integer of a query: digits and a sign. Stated after `Query`, whose limits would else be left out of the schema."""
Limit = Annotated[int, Query(ge=1, le=200, description="Most items of an answer."), IN_DIGITS]
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


def camera_example(**fields: Any) -> ConfigDict:
    """Configuration of a model of camera options: strict types, and one kind of optics."""
    config = examples(fields, rules=at_most_one_of(fov="number", intrinsics="object"))
    return ConfigDict(**config, strict=True)


class IntrinsicsModel(In, Pinhole):
    """A pinhole camera behind a lens; pixels, the centre of the first pixel is (0.5, 0.5)."""

    model_config = example(fx=420.0, fy=420.0, cx=200.0, cy=125.0)

    fx: StrictFloat = Field(gt=0, le=1e6)
    fy: StrictFloat = Field(gt=0, le=1e6)
    cx: StrictFloat = Field(ge=-1e6, le=1e6)
    cy: StrictFloat = Field(ge=-1e6, le=1e6)
