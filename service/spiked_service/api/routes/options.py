"""`options`: of a reconstruction, each kind of source, a camera profile and an upload, as JSON Schema."""

from typing import Any

from fastapi import APIRouter
from spiked_driver.source_kinds import KINDS

from spiked_service.api.problems import problems
from spiked_service.api.schemas.captures import ProfileModel, SourceKindOut, SourceKindsOut
from spiked_service.api.schemas.uploads import UploadRequest
from spiked_service.settings.reconstruction_options import ReconstructionOptions


def whole(schema: dict[str, Any]) -> dict[str, Any]:
    """A JSON schema with its references resolved, because references do not work in examples of OpenAPI."""
    definitions = schema.pop("$defs", {})

    def resolved(node: Any) -> Any:
        if isinstance(node, list):
            return [resolved(one) for one in node]
        if not isinstance(node, dict):
            return node
        name = str(node.get("$ref", "")).removeprefix("#/$defs/")
        if name in definitions:
            node = {**definitions[name], **{key: value for key, value in node.items() if key != "$ref"}}
        if "propertyName" in node:  # a discriminator, whose mapping has references
            return {"propertyName": node["propertyName"]}
        return {key: resolved(value) for key, value in node.items()}

    found: dict[str, Any] = resolved(schema)
    return found


_SCHEMA = whole(ReconstructionOptions.model_json_schema())
_PROFILE = whole(ProfileModel.model_json_schema())
_UPLOAD = whole(UploadRequest.model_json_schema())


def _answer(schema: dict[str, Any]) -> dict[int | str, dict[str, Any]]:
    """Of a route that answers with this JSON schema."""
    example = {"type": "object", "title": "JSON Schema", "additionalProperties": True, "examples": [schema]}
    return {
        200: {"description": "JSON Schema 2020-12.", "content": {"application/json": {"schema": example}}},
        **problems(),
    }


def option_routes() -> APIRouter:
    """`options`."""
    router = APIRouter()

    @router.get("/options", tags=["reconstructions"], responses=_answer(_SCHEMA))
    def get_options() -> dict[str, Any]:
        """The options of a reconstruction as JSON Schema: names, types, limits, defaults and meaning."""
        return _SCHEMA

    @router.get("/options/sources", tags=["devices"], responses=problems())
    def list_source_kinds() -> SourceKindsOut:
        """The kinds of sources a capture can name, with their options as JSON Schema."""
        return SourceKindsOut(
            items=[
                SourceKindOut(
                    name=kind.name,
                    usage=kind.usage,
                    summary=kind.summary,
                    is_camera=kind.is_camera,
                    can_block=kind.can_block,
                    takes_path=kind.takes_path,
                    options=whole(kind.options.model_json_schema()),
                )
                for kind in KINDS
            ]
        )

    @router.get("/options/profile", tags=["devices"], responses=_answer(_PROFILE))
    def get_profile_options() -> dict[str, Any]:
        """The fields of a camera profile as JSON Schema."""
        return _PROFILE

    @router.get("/options/upload", tags=["uploads"], responses=_answer(_UPLOAD))
    def get_upload_options() -> dict[str, Any]:
        """What an upload can state of its file and of the camera, as JSON Schema."""
        return _UPLOAD

    return router
