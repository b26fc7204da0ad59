"""Addresses of sources: the device that one names, and its pace."""

from urllib.parse import parse_qsl, urlencode

from pydantic import BaseModel
from spiked_driver.source_kind import Device, SourceSpec
from spiked_driver.source_kinds import find_kind

from spiked.camera import CameraFiles, CameraOptions

_ALIASES = {"flipped": "flip"}
"""Other names of options."""
_OPTICS = {"fov", "intrinsics"}
"""Options that both set the focal length."""


def device_of(source: str) -> str:
    """The device of a source: a camera without its options; a file or simulation with all but its pace."""
    address, _, query = source.partition("?")
    kind = find_kind(source)
    if kind is None or not kind.can_block:
        return address
    options = [option for option in query.split("&") if option and not option.startswith("pace=")]
    return f"{address}?{'&'.join(options)}" if options else address


def same_device(source: str, device: Device) -> bool:
    """Whether a source is the device: by its address, or because both names are of one port now."""
    if device_of(unpaced(source)) == device_of(unpaced(device.source)):
        return True
    kind = find_kind(source)
    port = None if kind is None or kind.name != device.kind else kind.describe(SourceSpec.parse(source)).port
    return port is not None and port == device.port


def stated_options(source: str) -> bool:
    """Whether the source states something of its camera."""
    names = {name for name, _ in parse_qsl(source.partition("?")[2], keep_blank_values=True)}
    return bool(names & (CameraOptions.model_fields.keys() | CameraFiles.model_fields.keys() | set(_ALIASES.values())))


def with_options(source: str, stated: BaseModel) -> str:
    """The source with options in place of those of the same name; a field of view and intrinsics replace each other."""
    given = stated.model_dump(mode="json", include=stated.model_fields_set, exclude_none=True)
    values = {name: _text(value) for name, value in given.items()}
    replaced = set(values) | {_ALIASES.get(name, name) for name in values}
    if replaced & _OPTICS:
        replaced |= _OPTICS
    address, _, query = source.partition("?")
    kept = [(name, value) for name, value in parse_qsl(query, keep_blank_values=True) if name not in replaced]
    pairs = kept + list(values.items())
    return f"{address}?{urlencode(pairs, safe='/:,')}" if pairs else address


def _text(value: object) -> str:
    """As it stands in a source's text."""
    match value:
        case bool():
            return "true" if value else "false"
        case dict():
            return ",".join(f"{number!r}" for number in value.values())
    return f"{value}"


def unpaced(source: str) -> str:
    """The source with `pace=0` unless it has a pace: files and simulations then wait for their readers.

    Cameras are unchanged. `pace=1` replays at the recorded rate and loses frames that are not read in time.
    """
    address, _, query = source.partition("?")
    kind = find_kind(source)
    if kind is None or not kind.can_block or "pace=" in query:
        return source
    return f"{address}?{query}&{urlencode({'pace': 0})}" if query else f"{address}?pace=0"


def realtime(source: str) -> str:
    """The source without `pace=0`: in real time, because an armed device has no reader to wait for."""
    address, _, query = source.partition("?")
    options = [option for option in query.split("&") if option and option != "pace=0"]
    return f"{address}?{'&'.join(options)}" if options else address
