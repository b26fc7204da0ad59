"""Reference of the REST API: operations by tag, and the models, made from the OpenAPI document of the service."""

import json
from collections.abc import Iterator
from typing import Any

from site_markdown import Schema, cell, code, default_of, fields_table, page, table, type_of
from spiked_service.daemon import api_document

FOLDER = "reference/rest"
MODELS = "models.md"
_METHODS = ("get", "post", "put", "patch", "delete")


def operations(document: Schema) -> Iterator[tuple[str, str, Schema]]:
    """Method, path and description of every operation."""
    for path, item in document["paths"].items():
        for method, operation in item.items():
            if method in _METHODS:
                yield method.upper(), path, operation


def tag_of(operation: Schema) -> str:
    """The page that an operation is on."""
    return str(operation.get("tags", ["operations"])[0])


def anchor(method: str, path: str) -> str:
    """The name of an operation within its page."""
    letters = [letter if letter.isalnum() else "-" for letter in path.removeprefix("/api/v1")]
    return f"{method.lower()}{''.join(letters)}".rstrip("-")


def scopes(operation: Schema) -> str:
    """The scope that a token needs."""
    named = [scope for one in operation.get("security", []) for scope in one.get("token", [])]
    return ", ".join(named) or "none"


def operation_block(method: str, path: str, operation: Schema) -> str:
    """Markdown of one operation."""
    parameters = [
        (
            code(one["name"]) + (" (required)" if one.get("required") else ""),
            one["in"],
            type_of(one["schema"], MODELS),
            default_of(one["schema"]),
            cell(one.get("description") or one["schema"].get("description", "")),
        )
        for one in operation.get("parameters", [])
    ]
    body = operation.get("requestBody", {}).get("content", {})
    sent = [f"{type_of(one.get('schema', {}), MODELS)} as {code(kind)}" for kind, one in body.items()]
    replies = operation["responses"]
    answers = [(code(key), answer(one), cell(one["description"])) for key, one in replies.items() if key < "4"]
    errors = [f"{code(key)} {one['description'].rstrip('.')}" for key, one in replies.items() if key >= "4"]
    return page(
        f"## `{method} {path}` {{ #{anchor(method, path)} }}",
        operation.get("description", ""),
        table(("parameter", "in", "type", "default", "meaning"), parameters),
        f"Body: {', or '.join(sent)}." if sent else "",
        example(body),
        table(("status", "answer", "meaning"), answers),
        f"Errors, each a [Problem]({MODELS}#Problem): {'; '.join(errors)}." if errors else "",
    ).rstrip()


def answer(response: Schema) -> str:
    """What a response holds."""
    kinds = [
        f"{type_of(one['schema'], MODELS)} as {code(kind)}" if one.get("schema") else code(kind)
        for kind, one in response.get("content", {}).items()
    ]
    return ", or ".join(kinds)


def example(body: dict[str, Any]) -> str:
    """The example of a body, if it states one of its own."""
    for one in body.values():
        shown = one.get("example") or next((each["value"] for each in one.get("examples", {}).values()), None)
        if shown is not None:
            return f"```json\n{json.dumps(shown, indent=2)}\n```"
    return ""


def tag_page(tag: Schema, found: list[tuple[str, str, Schema]]) -> str:
    """Markdown of the operations of one tag."""
    blocks = [operation_block(*one) for one in found if tag_of(one[2]) == tag["name"]]
    return page(f"# {tag['name'].capitalize()}", tag["description"], *blocks)


def models_page(document: Schema) -> str:
    """Markdown of every model: fields, types, an example."""
    blocks = []
    for name, schema in document["components"]["schemas"].items():
        fields = fields_table(schema, "") if "properties" in schema else f"Values: {type_of(schema, '')}."
        shown = next(iter(schema.get("examples", [])), None)
        blocks += [f"## {name} {{ #{name} }}", schema.get("description", ""), fields]
        blocks += [f"```json\n{json.dumps(shown, indent=2)}\n```"] if shown is not None else []
    return page("# Models", "What requests and answers hold, as JSON.", *blocks)


def index_page(document: Schema, found: list[tuple[str, str, Schema]]) -> str:
    """Markdown of what all operations share, and the list of them."""
    parts = []
    for tag in document["tags"]:
        rows = [
            (
                f"[`{method} {path}`]({tag['name']}.md#{anchor(method, path)})",
                cell(operation.get("description", "").split("\n\n")[0]),
                scopes(operation),
            )
            for method, path, operation in found
            if tag_of(operation) == tag["name"]
        ]
        heading = f"## [{tag['name'].capitalize()}]({tag['name']}.md)"
        parts += [heading, tag["description"], table(("operation", "what it does", "scope"), rows)]
    about = (
        "The running service has this reference with forms to try it at `/docs`, and the OpenAPI document at "
        "`/openapi.json`; `spiked openapi` prints it. [REST API](../../api.md) is a walk through it, "
        "[events](../../events.md) describes the WebSocket."
    )
    return page("# REST reference", document["info"]["description"].strip(), about, *parts)


def pages() -> dict[str, str]:
    """Every page of this reference: path below docs/ and Markdown."""
    document = api_document()
    found = list(operations(document))
    made = {f"{FOLDER}/{tag['name']}.md": tag_page(tag, found) for tag in document["tags"]}
    return {f"{FOLDER}/index.md": index_page(document, found), **made, f"{FOLDER}/{MODELS}": models_page(document)}
