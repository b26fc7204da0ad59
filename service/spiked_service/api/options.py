"""`options`: what can be chosen about a reconstruction, described by itself."""

from typing import Any

from fastapi import APIRouter

from spiked_service.api.problems import problems
from spiked_service.reconstruction_options import ReconstructionOptions

_SCHEMA = ReconstructionOptions.model_json_schema()
_EXAMPLE = {"type": "object", "title": "JSON Schema", "additionalProperties": True, "examples": [_SCHEMA]}


def option_routes() -> APIRouter:
    """`options`."""
    router = APIRouter(tags=["reconstructions"])

    @router.get(
        "/options",
        responses={
            200: {"description": "JSON Schema 2020-12.", "content": {"application/json": {"schema": _EXAMPLE}}},
            **problems(),
        },
    )
    def get_options() -> dict[str, Any]:
        """The options of a reconstruction as JSON Schema: names, types, limits, defaults and meaning."""
        return _SCHEMA

    return router
