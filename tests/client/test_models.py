"""The client's models are those of the service."""

import importlib.util
from pathlib import Path

import pytest

GENERATOR = Path(__file__).with_name("generate.py")


def test_the_models_are_those_that_the_service_describes() -> None:
    pytest.importorskip("datamodel_code_generator")
    spec = importlib.util.spec_from_file_location("generate", GENERATOR)
    assert spec is not None and spec.loader is not None
    generate = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(generate)
    made = generate.generate(generate.openapi())
    assert generate.MODELS.read_text() == made, "run make api"
