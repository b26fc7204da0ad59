"""Kinds of path segments, which separate ids from actions: `captures/ID:stop` is not a capture named `ID:stop`."""

import re
from functools import cache
from typing import Any

from starlette.convertors import Convertor, register_url_convertor

_METHODS = frozenset({"get", "post", "put", "patch", "delete"})


class _Id(Convertor[str]):
    """An id: text without slash and colon."""

    regex = "[^/:]+"

    def convert(self, value: str) -> str:
        return value

    def to_string(self, value: str) -> str:
        return value


class _DeviceId(Convertor[str]):
    """The id of a device, which may contain slashes and colons, up to the action."""

    regex = "(?:(?!:(?:dis)?arm$|/profile:calibrate$).)+"

    def convert(self, value: str) -> str:
        return value

    def to_string(self, value: str) -> str:
        return value


def register_path_kinds() -> None:
    """Register `{name:id}` and `{name:device}`. Call before any route is made."""
    register_url_convertor("id", _Id())
    register_url_convertor("device", _DeviceId())


def allowed_methods(described: dict[str, Any], path: str) -> list[str]:
    """The methods of a path in an OpenAPI document, for an Allow header."""
    found = {
        method.upper()
        for template, methods in described["paths"].items()
        if _pattern(template).fullmatch(path)
        for method in methods
        if method in _METHODS
    }
    return sorted({*found, "HEAD"} if "GET" in found else found)


@cache
def _pattern(template: str) -> re.Pattern[str]:
    parts = re.split(r"(\{\w+\})", template)
    kinds = {"{device_id}": _DeviceId.regex}
    return re.compile("".join(kinds.get(p, _Id.regex) if p.startswith("{") else re.escape(p) for p in parts))
