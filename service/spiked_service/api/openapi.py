"""The description of the API: what FastAPI finds in the routes, and what they have in common."""

from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi

from spiked_service.api.problems import Problem

DESCRIPTION = """Captures from spike cameras, recorded and reconstructed while they run.

* **Poses** are camera-to-world with OpenCV axes (x right, y down, z forward); quaternions are wxyz.
* **Frames** are absolute indices since the start of their capture. Times within a capture are seconds (`_s`), others
  ISO 8601 in UTC (`_at`), sizes are bytes (`_bytes`).
* **Radiance** is in expected spikes a frame; pictures but EXR are divided by a `white`.
* **Errors** are RFC 9457 problem details, with `what_to_do`.
* **Lists** are pages: ask again with `cursor` = `next_cursor` until that is null.
* **POSTs** heed `Idempotency-Key`: sent again with the same key, they do their work once.

```
curl -X POST localhost:8650/api/v1/captures -H 'content-type: application/json' -d '{"source": "sim:", "frames": 1280}'
curl localhost:8650/api/v1/captures/ID/trajectory?format=tum -o trajectory.tum
curl -X POST localhost:8650/api/v1/captures/ID/views -H 'content-type: application/json' \\
     -d '{"camera": {"frame": 100}}' -o view.png
```
"""
TAGS = (
    ("captures", "Frames of a camera, from here or uploaded: recorded, looked at, reconstructed."),
    ("reconstructions", "Jobs that make a trajectory and a scene of a capture, and their versions."),
    ("devices", "What can be captured from."),
    ("uploads", "Recordings from elsewhere, sent in chunks."),
    ("operations", "Health, settings, tokens."),
)


def describe(app: FastAPI) -> None:
    """Let the application describe itself so."""

    def openapi() -> dict[str, Any]:
        if app.openapi_schema is None:
            app.openapi_schema = _described(app)
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
    components = schema.setdefault("components", {})
    problem = Problem.model_json_schema(mode="serialization", ref_template="#/components/schemas/{model}")
    components.setdefault("schemas", {})["Problem"] = problem
    components["schemas"] = dict(sorted(components["schemas"].items()))
    components["securitySchemes"] = {
        "token": {"type": "http", "scheme": "bearer", "description": "Where the service asks for one."}
    }
    schema["security"] = [{}, {"token": []}]
    return schema
