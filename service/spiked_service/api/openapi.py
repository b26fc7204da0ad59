"""The OpenAPI document: the routes as FastAPI describes them, with scopes, problems and tags."""

import json
from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi

from spiked_service.api.auth.scopes import scope_of, security
from spiked_service.api.problems import Problem
from spiked_service.api.routes.guide import PATH as GUIDE_PATH
from spiked_service.settings.tokens import Scope

DESCRIPTION = """Captures from spike cameras, recorded and reconstructed while they run.

* **Poses** are camera-to-world with OpenCV axes (x right, y down, z forward); quaternions are wxyz.
* **Frames** are absolute indices since the start of their capture. Times within a capture are seconds (`_s`), others
  ISO 8601 in UTC (`_at`), sizes are bytes (`_bytes`).
* **Radiance** is in expected spikes a frame; pictures but EXR are divided by a `white`.
* **Errors** are RFC 9457 problem details, with `what_to_do`.
* **Lists** of captures and reconstructions are pages: repeat the request with `cursor` = `next_cursor` until that is
  null. All other lists are complete.
* **Tokens**, if the service requires them, have a scope: `read` reads and downloads, `operate` also changes captures,
  reconstructions and uploads, `admin` also reads and changes the settings. Each operation states its scope.
* **POSTs** support `Idempotency-Key`: a request that is sent again with its key is carried out once.

```
curl -X POST localhost:8650/api/v1/captures -H 'content-type: application/json' -d '{"source": "sim:", "frames": 1280}'
curl localhost:8650/api/v1/captures/ID/trajectory?format=tum -o trajectory.tum
curl -X POST localhost:8650/api/v1/captures/ID/views -H 'content-type: application/json' \\
     -d '{"camera": {"frame": 100}}' -o view.png
```
"""
SCOPES = {
    Scope.READ: "read and download all captures and results",
    Scope.OPERATE: "also start, change and remove captures, reconstructions and uploads",
    Scope.ADMIN: "also read and change the settings of the service",
}
_SCHEMA_NAMES = {"CheckStatus": "Verdict", "DiagnosisStatus": "Status"}
"""Public names of schemas that differ from the names of their classes."""
_OPEN = frozenset({"/healthz", "/readyz"})
TAGS = (
    ("captures", "Frames of a camera, captured or uploaded: recordings, previews and results."),
    ("reconstructions", "Jobs that estimate a trajectory and a scene from a capture, and their versions."),
    ("devices", "Sources of captures."),
    ("uploads", "Recordings sent in chunks."),
    ("operations", "Health, settings, tokens."),
)


def describe(app: FastAPI) -> None:
    """Set the OpenAPI document of the application."""

    def openapi() -> dict[str, Any]:
        if app.openapi_schema is None:
            app.openapi_schema = _renamed(_described(app))
        return app.openapi_schema

    app.openapi = openapi  # type: ignore[method-assign]


def _described(app: FastAPI) -> dict[str, Any]:
    schema = get_openapi(
        title=app.title,
        version=app.version,
        description=DESCRIPTION,
        routes=app.routes,
        tags=[{"name": name, "description": text} for name, text in TAGS],
        license_info={"name": "Apache-2.0", "identifier": "Apache-2.0"},
        separate_input_output_schemas=True,
    )
    schema["externalDocs"] = {"description": "Documentation, with search", "url": GUIDE_PATH}
    components = schema.setdefault("components", {})
    problem = Problem.model_json_schema(mode="serialization", ref_template="#/components/schemas/{model}")
    components.setdefault("schemas", {})["Problem"] = problem
    components["schemas"] = dict(sorted(components["schemas"].items()))
    components["securitySchemes"] = {
        "token": {
            "type": "http",
            "scheme": "bearer",
            "description": "If the service requires one. Each operation states the scope that it needs: "
            + "; ".join(f"{scope}: {text}" for scope, text in SCOPES.items()),
        }
    }
    for path, operations in schema["paths"].items():
        for method, operation in operations.items():
            needed = scope_of(method, operation.get("security"))
            operation["security"] = [{}] if path in _OPEN else security(needed)
            scope = "Needs no token." if path in _OPEN else f"Scope of a token: `{needed}`."
            operation["description"] = "\n\n".join(part for part in (operation.get("description"), scope) if part)
    return schema


def _renamed(document: dict[str, Any]) -> dict[str, Any]:
    """The same document with `_SCHEMA_NAMES` for the names of classes."""
    text = json.dumps(document)
    for name, public in _SCHEMA_NAMES.items():
        text = text.replace(f'"#/components/schemas/{name}"', f'"#/components/schemas/{public}"')
    schema: dict[str, Any] = json.loads(text)
    schemas = schema["components"]["schemas"]
    for name, public in _SCHEMA_NAMES.items():
        schemas[public] = schemas.pop(name) | {"title": public}
    schema["components"]["schemas"] = dict(sorted(schemas.items()))
    return schema
