"""Pieces of Markdown that the generated pages share: cells of tables, and types of JSON schemas."""

import json
import re
from typing import Any

Schema = dict[str, Any]


def cell(text: str) -> str:
    """Text of one table cell: one line, with no character that would end the cell or open a tag."""
    line = " ".join(text.split()).replace("|", "\\|")
    parts = re.split(r"(`[^`]*`)", line)
    return "".join(part if part.startswith("`") else part.replace("<", "&lt;") for part in parts)


def code(text: str) -> str:
    """Text between backticks, for a table cell."""
    return f"`{text}`".replace("|", "\\|") if text else ""


def table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    """A table of finished cells; nothing without rows."""
    if not rows:
        return ""
    lines = [head, tuple("---" for _ in head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def page(*parts: str) -> str:
    """Blocks of a page, those that are empty left out."""
    return "\n\n".join(part for part in parts if part) + "\n"


def type_of(schema: Schema, models: str) -> str:
    """The type of a JSON schema with its bounds, as Markdown; `models` is the page that the named ones are on."""
    if "$ref" in schema:
        name = schema["$ref"].rsplit("/", 1)[-1]
        return f"[{name}]({models}#{name})"
    for key in ("anyOf", "oneOf", "allOf"):
        if key in schema:
            return " or ".join(dict.fromkeys(type_of(one, models) for one in schema[key]))
    if "const" in schema:
        return code(json.dumps(schema["const"]))
    if "enum" in schema:
        return ", ".join(code(json.dumps(value)) for value in schema["enum"])
    return _plain_type(schema, models)


def _plain_type(schema: Schema, models: str) -> str:
    """The type of a schema that is no reference, union or enumeration."""
    kind = schema.get("type", "any value")
    if isinstance(kind, list):
        return " or ".join(kind)
    if kind == "array":
        given = [type_of(one, models) for one in schema.get("prefixItems", [])]
        items = ", ".join(given) if given else type_of(schema.get("items", {}), models)
        return f"array of {items}{_bounds(schema)}"
    extra = schema.get("additionalProperties")
    if kind == "object" and isinstance(extra, dict):
        return f"object of {type_of(extra, models)}"
    return f"{schema.get('format', '') + ' ' if schema.get('format') else ''}{kind}{_bounds(schema)}"


def _bounds(schema: Schema) -> str:
    """Bounds of a number, text or array, after a comma."""
    found = []
    for key, words in {
        "minimum": "≥ {}", "exclusiveMinimum": "> {}", "maximum": "≤ {}", "exclusiveMaximum": "< {}",
        "minLength": "at least {} characters", "maxLength": "at most {} characters",
        "minItems": "at least {} items", "maxItems": "at most {} items",
    }.items():  # fmt: skip
        if key == "minLength" and schema.get(key) == 1:
            found.append("not empty")
        elif key in schema:
            found.append(words.format(_number(schema[key])))
    return f", {', '.join(found)}" if found else ""


def _number(value: float) -> str:
    """A number without a fraction of zero, and long ones with separators."""
    return f"{int(value):,}" if float(value).is_integer() and abs(value) < 1e19 else f"{value:g}"


def default_of(schema: Schema) -> str:
    """The default of a JSON schema as code; empty if there is none or it is null."""
    value = schema.get("default")
    return "" if value is None else code(json.dumps(value))


def fields_table(schema: Schema, models: str) -> str:
    """A table of the properties of an object: name, type, default, meaning."""
    needed = schema.get("required", [])
    rows = [
        (
            code(name) + (" (required)" if name in needed and "default" not in one else ""),
            type_of(one, models),
            default_of(one),
            cell(one.get("description", "")),
        )
        for name, one in schema.get("properties", {}).items()
    ]
    return table(("field", "type", "default", "meaning"), rows)
