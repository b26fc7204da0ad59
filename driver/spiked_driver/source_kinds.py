"""The registry of source kinds. A new kind is a module with a `SourceKind` and one line in `KINDS`."""

from typing import Any

from spiked.errors import SourceError
from spiked_driver import pcie, replay, simulated, usb_kind
from spiked_driver.source_kind import Device, SourceKind, SourceSpec

__all__ = ["KINDS", "find_kind", "is_camera", "kind_of", "known_devices"]

KINDS: list[SourceKind[Any]] = [
    usb_kind.KIND,
    pcie.KIND,
    replay.KIND,
    simulated.KIND,
]
"""In the order in which devices are listed."""


def find_kind(spec: str) -> SourceKind[Any] | None:
    """The kind that a source's text names; None if there is none."""
    parts = SourceSpec.parse(spec)
    return next((kind for kind in KINDS if kind.matches(parts)), None)


def kind_of(spec: str) -> SourceKind[Any]:
    """The kind that a source's text names. Raises SourceError."""
    kind = find_kind(spec)
    if kind is not None:
        return kind
    parts = SourceSpec.parse(spec)
    *some, last = (kind.usage for kind in KINDS)
    if parts.target is None:
        raise SourceError(f"source {spec!r} names no kind: write {', '.join(some)} or {last}")
    raise SourceError(f"source {spec!r}: there is no kind {parts.name!r}, only {', '.join(some)} and {last}")


def is_camera(spec: str) -> bool:
    """Whether the text names a camera, which cannot wait."""
    kind = find_kind(spec)
    return kind is not None and kind.is_camera


def known_devices(configured: list[str]) -> list[Device]:
    """The configured sources, then what each kind finds on this machine."""
    named = [_described(source) for source in configured]
    ports = {device.port for device in named if device.port}
    found = [device for kind in KINDS for device in kind.find()]
    return named + [one for one in found if one.source not in configured and one.port not in ports]


def _described(source: str) -> Device:
    try:
        return kind_of(source).describe(SourceSpec.parse(source))
    except SourceError as error:
        return Device(source, SourceSpec.parse(source).name, "an unknown kind of source", reason=str(error))
