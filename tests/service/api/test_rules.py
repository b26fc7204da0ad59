"""The description says all that a body must be: what it allows is accepted, and its references lead somewhere."""

import json
from collections.abc import Iterator
from functools import cache
from typing import Any

import jsonschema_rs
import pytest
import schemathesis
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pydantic import BaseModel, ValidationError
from spiked_service.api.routes.options import whole
from spiked_service.api.schemas.base import In

UNSAID = ("c2w is not a rotation", "quaternion_wxyz is zero", "folds the image")
"""The rules that JSON Schema cannot say, or only so that no tool understands it."""


def models() -> Iterator[type[BaseModel]]:
    waiting: list[type[BaseModel]] = [In]
    while waiting:
        for model in waiting.pop().__subclasses__():
            waiting.append(model)
            yield model


@cache
def bodies(model: type[BaseModel]) -> st.SearchStrategy[Any]:
    """What its schema allows."""
    content = {"application/json": {"schema": whole(model.model_json_schema())}}
    operation = {"requestBody": {"required": True, "content": content}, "responses": {"200": {"description": ""}}}
    described = {"openapi": "3.1.0", "info": {"title": "", "version": "1"}, "paths": {"/": {"post": operation}}}
    return schemathesis.openapi.from_dict(described)["/"]["POST"].as_strategy().map(lambda case: case.body)


@pytest.mark.parametrize("model", sorted(models(), key=lambda model: model.__name__), ids=lambda model: model.__name__)
@settings(max_examples=30, deadline=None, suppress_health_check=list(HealthCheck), derandomize=True)
@given(data=st.data())
def test_what_the_schema_allows_is_accepted(model: type[BaseModel], data: st.DataObject) -> None:
    body = data.draw(bodies(model))
    try:
        model.model_validate_json(json.dumps(body))
    except ValidationError as error:
        told = [one for one in error.errors(include_url=False) if not any(rule in one["msg"] for rule in UNSAID)]
        assert not told, (body, told)


@pytest.mark.parametrize(
    ("name", "body"),
    [
        ("CaptureRequest", {}),
        ("CaptureRequest", {"source": None, "device": None}),
        ("CaptureRequest", {"source": "sim:", "device": "sim:"}),
        ("CaptureRequest", {"source": "sim:", "frames": 5, "seconds": 1}),
        ("CaptureRequest", {"source": "sim:", "record": False, "reconstruct": False}),
        ("ViewRequest", {}),
        ("ViewRequest", {"path": {"count": 3}, "camera": {"frame": 1}}),
        ("ViewRequest", {"path": {"count": 3}, "width": 100}),
        ("ViewRequest", {"path": {"count": 3}, "background": [0, 0, -1]}),
        ("CameraModel", {"position": [0, 0, 0]}),
        ("CameraModel", {"position": [0, 0, 1e10], "quaternion_wxyz": [1, 0, 0, 0]}),
    ],
)
def test_what_is_refused_the_schema_forbids(name: str, body: dict[str, Any]) -> None:
    (model,) = {model for model in models() if model.__name__ == name}
    with pytest.raises(ValidationError):
        model.model_validate(body)
    assert not jsonschema_rs.validator_for(model.model_json_schema()).is_valid(body)


def references(node: Any) -> Iterator[str]:
    if isinstance(node, dict):
        if isinstance(node.get("$ref"), str):
            yield node["$ref"]
        node = list(node.values())
    if isinstance(node, list):
        for one in node:
            yield from references(one)


def test_every_reference_leads_somewhere(service: Any) -> None:
    """In examples, too: tools resolve those as well."""
    described = service.http.get(f"{service.daemon.address}openapi.json").json()
    found = set(references(described))
    assert len(found) > 30
    for reference in found:
        node = described
        for part in reference.removeprefix("#/").split("/"):
            assert part in node, reference
            node = node[part]
    assert not set(references(service.http.get("options").json()))


def test_what_a_header_may_be_is_no_null(service: Any) -> None:
    described = service.http.get(f"{service.daemon.address}openapi.json").json()
    headers = [
        parameter
        for operations in described["paths"].values()
        for operation in operations.values()
        for parameter in operation.get("parameters", [])
        if parameter["in"] == "header"
    ]
    assert headers
    for header in headers:
        assert header["schema"].get("type") in ("string", "integer"), header


def test_kinds_of_sources_are_listed_with_the_schema_of_their_options(service: Any) -> None:
    kinds = {kind["name"]: kind for kind in service.http.get("options/sources").json()["items"]}
    assert list(kinds) == ["usb", "pcie", "replay", "sim"]
    assert (kinds["replay"]["usage"], kinds["replay"]["takes_path"], kinds["usb"]["is_camera"]) == (
        "replay:FILE",
        True,
        True,
    )
    seed = kinds["sim"]["options"]["properties"]["seed"]
    assert (seed["type"], seed["minimum"], seed["default"]) == ("integer", 0, 0)
    motion = kinds["sim"]["options"]["properties"]["motion"]
    assert "hand_shake" in motion["enum"], "resolved, not a reference"
