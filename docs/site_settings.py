"""Reference of the settings of the service and of the options of sources, made from their models."""

from site_markdown import Schema, cell, code, default_of, page, table, type_of
from spiked_driver.source_kinds import KINDS
from spiked_service.settings.settings import Settings, flag_of, reloadable

SETTINGS = "reference/settings.md"
SOURCES = "reference/sources.md"
_COLUMNS = ("environment", "command line", "type", "default", "a reload applies it")
_HOW = (
    "Each setting has one name in the TOML file, in the environment and on the command line. Flags override the "
    "environment, and the environment overrides the file; [Running the service](../operations.md#settings) says where "
    "the file is. `spiked config show` prints the values in effect and their origins."
)


def schema_of(schema: Schema, shared: Schema) -> Schema:
    """The schema of a field with its named types in place of their references."""
    if "$ref" in schema:
        return {**shared[schema["$ref"].rsplit("/", 1)[-1]], **{k: v for k, v in schema.items() if k != "$ref"}}
    found = dict(schema)
    if "anyOf" in found:
        given = [schema_of(one, shared) for one in found["anyOf"]]
        found["anyOf"] = [one for one in given if one.get("type") != "null"]
    return found


def settings_page() -> str:
    """Markdown of every setting, each below a heading of its own, which the search finds."""
    document = Settings.model_json_schema()
    shared = document.get("$defs", {})
    blocks = []
    for name, given in document["properties"].items():
        schema = schema_of(given, shared)
        row = (
            code(f"SPIKED_{name.upper()}"),
            code(flag_of(name)),
            type_of(schema, ""),
            default_of(schema) or "not set",
            "yes" if reloadable(name) else "",
        )
        blocks += [f"## {name} {{ #{name} }}", cell(given["description"]), table(_COLUMNS, [row])]
    return page("# Settings", _HOW, *blocks)


def sources_page() -> str:
    """Markdown of every kind of source and its options."""
    blocks = []
    for kind in KINDS:
        document = kind.options.model_json_schema()
        shared = document.get("$defs", {})
        rows = [
            (code(name), type_of(schema_of(one, shared), ""), default_of(one), cell(one.get("description", "")))
            for name, one in document.get("properties", {}).items()
        ]
        blocks += [f"## {kind.name} {{ #{kind.name} }}", f"`{kind.usage}`: {cell(kind.summary)}."]
        blocks += [table(("option", "type", "default", "meaning"), rows)]
    how = (
        "A source is what a capture takes its frames from. Options follow a question mark and are separated by `&`: "
        "`sim:?pace=1&seed=3`. The command line, `POST captures` and the page take the same text."
    )
    return page("# Sources and their options", how, *blocks)


def pages() -> dict[str, str]:
    """Every page of this reference: path below docs/ and Markdown."""
    return {SETTINGS: settings_page(), SOURCES: sources_page()}
