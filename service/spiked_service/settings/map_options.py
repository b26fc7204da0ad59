"""Fields of the map's options by name, for experiments: what each one is worth is a row of `spiked compare`."""

from collections.abc import Iterator, Sequence
from dataclasses import fields, is_dataclass, replace
from typing import Any, get_type_hints

from pydantic import ConfigDict, TypeAdapter, ValidationError

from spiked.errors import ConfigurationError
from spiked.recon import MapOptions

OWN_OPTION = {"loss"}
"""Fields that have an option of their own."""


def map_option_names(options: object = MapOptions()) -> Iterator[str]:
    """The names that `changed` knows, with a dot for the parts of an option."""
    for field in fields(options):  # type: ignore[arg-type]
        value = getattr(options, field.name)
        if is_dataclass(value):
            yield from (f"{field.name}.{name}" for name in map_option_names(value))
        elif field.name not in OWN_OPTION:
            yield field.name


def changed(options: MapOptions, texts: Sequence[str]) -> MapOptions:
    """The options with fields replaced, each text NAME=VALUE. Raises ConfigurationError."""
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals or name not in set(map_option_names()):
            raise ConfigurationError(
                f"--map-option {text!r}: write NAME=VALUE, with one of the names {', '.join(map_option_names())}"
            )
        options = _replaced(options, name.split("."), value, text)
    return options


def _replaced(options: Any, path: list[str], value: str, text: str) -> Any:
    name, *rest = path
    if rest:
        return replace(options, **{name: _replaced(getattr(options, name), rest, value, text)})
    try:
        kind = TypeAdapter[Any](get_type_hints(type(options))[name], config=ConfigDict(allow_inf_nan=False))
        parsed = kind.validate_python(None) if value == "none" else kind.validate_strings(value)
    except ValidationError as error:
        raise ConfigurationError(f"--map-option {text!r}: {error.errors()[0]['msg']}") from error
    return replace(options, **{name: parsed})
