"""Makes `spiked/client/models.py` from the OpenAPI description: `python tests/client/generate.py [FILE]`.

The client does not check what the service checks, so that limits and rules between fields, which would become a class
each, are left out.
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

MODELS = Path(__file__).parents[2] / "spiked" / "client" / "models.py"
_LIMITS = frozenset(
    ("minimum", "maximum", "exclusiveMinimum", "exclusiveMaximum", "minLength", "maxLength", "minItems", "maxItems")
)
_LEFT_OUT = _LIMITS | {"pattern", "title", "examples", "example", "allOf"}
_HEADER = '"""What goes over HTTP: made from the OpenAPI description, see tests/client."""'
_OPTIONS = (
    "--input-file-type",
    "openapi",
    "--output-model-type",
    "pydantic_v2.BaseModel",
    "--target-python-version",
    "3.11",
    "--formatters",
    "builtin",
    "--extra-fields",
    "ignore",
    "--use-standard-collections",
    "--use-union-operator",
    "--strict-nullable",
    "--use-schema-description",
    "--disable-timestamp",
    "--use-subclass-enum",
    "--collapse-root-models",
    "--use-annotated",
    "--set-default-enum-member",
    "--use-one-literal-as-default",
)


def openapi() -> dict[str, Any]:
    """As `spiked openapi` prints it."""
    command = [sys.executable, "-m", "spiked_service", "openapi"]
    return dict(json.loads(subprocess.run(command, check=True, capture_output=True, timeout=120).stdout))


def generate(schema: dict[str, Any]) -> str:
    """The text of the module."""
    with tempfile.TemporaryDirectory() as folder:
        source, made = Path(folder) / "openapi.json", Path(folder) / "models.py"
        source.write_text(json.dumps(_plain(schema)))
        command = [sys.executable, "-m", "datamodel_code_generator", "--input", str(source), "--output", str(made)]
        subprocess.run(
            [*command, *_OPTIONS, "--custom-file-header", _HEADER], check=True, timeout=120, cwd=MODELS.parents[2]
        )
        return _formatted(made.read_text())


def _formatted(code: str) -> str:
    """As the rest of the code."""
    for command in (["check", "--fix", "--exit-zero", "--quiet"], ["format", "--quiet"]):
        code = subprocess.run(
            [sys.executable, "-m", "ruff", *command, "--stdin-filename", str(MODELS), "-"],
            input=code,
            check=True,
            capture_output=True,
            text=True,
            cwd=MODELS.parents[2],
        ).stdout
    return code


def _plain(node: Any, inside: str = "") -> Any:
    """Without limits; names of properties are not keywords."""
    if isinstance(node, dict) and "prefixItems" in node:
        return {"type": "array", "items": _plain(node["prefixItems"][0])}  # all of ours are of one type
    if isinstance(node, dict):
        kept = node if inside in ("properties", "schemas") else {k: v for k, v in node.items() if k not in _LEFT_OUT}
        return {key: _plain(value, key) for key, value in kept.items()}
    if isinstance(node, list):
        return [_plain(value) for value in node]
    return node


if __name__ == "__main__":
    described = json.loads(Path(sys.argv[1]).read_text()) if sys.argv[1:] else openapi()
    MODELS.write_text(generate(described))
