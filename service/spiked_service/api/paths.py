"""Kinds of path segments, so that an action is told from an id: `captures/ID:stop` is no capture named `ID:stop`."""

import re
from functools import cache
from typing import Any

from starlette.convertors import Convertor, register_url_convertor

_METHODS = frozenset({"get", "post", "put", "patch", "delete"})


class _Id(Convertor[str]):
    """An id: anything without slash and colon; whether there is such a thing is found out later."""

    regex = "[^/:]+"

    def convert(self, value: str) -> str:
        return value

    def to_string(self, value: str) -> str:
        return value


class _DeviceId(Convertor[str]):
    """The id of a device, which may hold slashes and colons, up to the action."""

    regex = "(?:(?!:(?:dis)?arm$).)+"

    def convert(self, value: str) -> str:
        return value

    def to_string(self, value: str) -> str:
        return value


def register_path_kinds() -> None:
    """Make `{name:id}` and `{name:device}` known; to be called before routes are made."""
    register_url_convertor("id", _Id())
    register_url_convertor("device", _DeviceId())


def allowed_methods(described: dict[str, Any], path: str) -> list[str]:
    """The methods that an OpenAPI description has for a path, for an Allow header."""
    found = {
        method.upper()
        for template, methods in described["paths"].items()
        if _pattern(template).fullmatch(path)
        for method in methods
        if method in _METHODS
    }
    return sorted(found)


@cache
def _pattern(template: str) -> re.Pattern[str]:
    parts = re.split(r"(\{\w+\})", template)
    kinds = {"{device_id}": _DeviceId.regex}
    return re.compile("".join(kinds.get(p, _Id.regex) if p.startswith("{") else re.escape(p) for p in parts))
