"""A value of another type than the description says is refused, even where it could be converted."""

import json
from collections.abc import Iterator
from typing import Any

import pytest
from pydantic import BaseModel, ValidationError
from spiked_service.api.schemas.base import In
from spiked_service.api.schemas.uploads import UploadSidecar
from spiked_service.settings.reconstruction_options import IntrinsicsOption, ReconstructionOptions

from spiked.recording import sidecar

WRONG: dict[str, tuple[object, ...]] = {
    "number": (True, "1", None),
    "integer": (True, "1", 1.5, None),
    "boolean": (1, 0, "true", None),
    "string": (1, True, None),
}


def models() -> Iterator[type[BaseModel]]:
    """All that a body can hold."""
    waiting: list[type[BaseModel]] = [In]
    while waiting:
        for model in waiting.pop().__subclasses__():
            waiting.append(model)
            yield model
    yield from (UploadSidecar, ReconstructionOptions, IntrinsicsOption, sidecar.Gap, sidecar.ClockPair, sidecar.Pinhole)


def fields() -> Iterator[Any]:
    """Models, names of fields, and wrong values for them."""
    for model in models():
        for name, schema in model.model_json_schema()["properties"].items():
            types = {one.get("type") for one in schema.get("anyOf", (schema,)) if "$ref" not in one}
            if "array" in types or types <= {None, "null", "object"}:
                continue
            wrong = [value for kind in types & WRONG.keys() for value in WRONG[kind]]
            for value in wrong:
                if not (value is None and "null" in types):
                    yield pytest.param(model, name, value, id=f"{model.__name__}.{name}={json.dumps(value)}")


@pytest.mark.parametrize(("model", "name", "value"), list(fields()))
def test_another_type_is_refused(model: type[BaseModel], name: str, value: object) -> None:
    with pytest.raises(ValidationError) as caught:
        model.model_validate({name: value})
    assert name in {error["loc"][0] for error in caught.value.errors() if error["type"] != "missing"}
