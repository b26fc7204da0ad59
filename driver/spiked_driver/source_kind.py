"""What a kind of source declares: its name, options, how it opens, and what the service may do with it.

The options of a kind are a pydantic model. Its fields carry types, bounds and descriptions, so that the command line,
`GET options/sources` and the error messages need nothing else.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Generic, TypeVar

from pydantic import BaseModel, BeforeValidator, Field, WithJsonSchema

from spiked.camera import CameraFiles, CameraOptions, Rate
from spiked.errors import SourceError
from spiked.recording.geometry import Assumable
from spiked.ring import DeviceState
from spiked_driver.capabilities import Capability
from spiked_driver.fault_options import FaultOptions
from spiked_driver.source import Source

__all__ = [
    "Device",
    "HardwareOptions",
    "PacedOptions",
    "SourceKind",
    "SourceOptions",
    "SourceSpec",
    "Warn",
    "path_of",
]

Warn = Callable[[str], None]
"""Called with one sentence for each fault of a camera that a capture survives."""
RATE_HZ = 20_000.0
"""Frame rate of both cameras by their data sheets; neither stream carries it."""
Pace = Annotated[
    float,
    Field(ge=0, le=1e4),
    BeforeValidator(lambda value: 0.0 if value == "max" else value),
    WithJsonSchema({"anyOf": [{"type": "number", "minimum": 0, "maximum": 1e4}, {"const": "max"}]}),
]


class PacedOptions(FaultOptions):
    """Options of every source that is not a camera: its pace, and the faults to inject."""

    pace: Pace = 1.0
    """Factor of the sensor's frame rate; 0 or `max`: as fast as lossless consumers take frames."""


class SourceOptions(CameraFiles, CameraOptions):
    """What a camera is, as options of a source; what is stated wins over what the source itself says."""


class HardwareOptions(SourceOptions):
    """Options of every camera."""

    rate: Rate = RATE_HZ
    """Frames per second; the stream does not carry it."""


@dataclass(frozen=True)
class SourceSpec:
    """A source as text, `KIND:TARGET?OPTIONS`, in its parts. A numbered kind is also written `KIND0`."""

    text: str
    address: str
    """Everything before the question mark."""
    name: str
    """Everything before the colon, with the number."""
    target: str | None
    """What follows the colon; None without a colon."""
    query: str

    @classmethod
    def parse(cls, text: str) -> "SourceSpec":
        """Split the text; any text is valid here."""
        address, _, query = text.partition("?")
        name, colon, target = address.partition(":")
        return cls(text, address, name, target if colon else None, query)


@dataclass(frozen=True)
class Device:
    """A source that a capture can be started from."""

    source: str
    """Its text, as `POST captures` takes it."""
    kind: str
    description: str
    state: DeviceState = DeviceState.IDLE
    """State without a capture: absent or idle."""
    reason: str = ""
    """Why it is absent or not usable."""
    serial: str | None = None
    port: str | None = None
    speed: str | None = None
    firmware: str | None = None
    capabilities: Mapping[str, Capability] = field(default_factory=dict)


def _no_recording(spec: SourceSpec) -> Path | None:
    """Of a source that is none."""
    return None


def _nothing_assumed(source: object, options: object) -> tuple[Assumable, ...]:
    """Of a source that knows its sensor."""
    return ()


_Options = TypeVar("_Options", bound=BaseModel)


@dataclass(frozen=True)
class SourceKind(Generic[_Options]):
    """One kind of source. A new one is a module that makes this object, and its line in `source_kinds`."""

    name: str
    """Lower-case letters: the text before the colon."""
    usage: str
    """How it is written, as `replay:FILE`."""
    summary: str
    """One line, as shown to users."""
    options: type[_Options]
    open: Callable[[SourceSpec, _Options, Warn | None], Source]
    """Make the source without starting it. Raises SourceError or RecordingError."""
    describe: Callable[[SourceSpec], Device]
    """The device that a text names, whether or not it is present. Raises nothing."""
    find: Callable[[], list[Device]] = list
    """Devices of this kind that are present without being configured."""
    assumed: Callable[[Any, _Options], tuple[Assumable, ...]] = _nothing_assumed
    """Properties of an opened source's sensor that nobody stated."""
    recording_of: Callable[[SourceSpec], Path | None] = _no_recording
    """The recording that is the source, whose sidecar describes the camera."""
    is_camera: bool = False
    """Hardware: frames that are not read in time are lost, and its process runs with real-time priority."""
    can_block: bool = False
    """With the option `pace=0` it waits for lossless consumers instead of losing frames."""
    takes_path: bool = False
    """The target is a path on the machine of the service; requests may name those in `source_folders` only."""
    numbered: bool = False
    """`usb0` is the first device of the kind."""

    @property
    def takes_faults(self) -> bool:
        """Whether faults can be injected by its options."""
        return issubclass(self.options, FaultOptions)

    def matches(self, spec: SourceSpec) -> bool:
        """Whether a text names a source of this kind."""
        if self.numbered and spec.name.removeprefix(self.name).isdecimal() and spec.name.startswith(self.name):
            return True
        return spec.name == self.name and (spec.target is not None or self.numbered)


def path_of(spec: SourceSpec, usage: str) -> str:
    """The target of a kind that takes a path. Raises SourceError if it is empty."""
    if not spec.target:
        raise SourceError(f"source {spec.text!r} names no path: write {usage}")
    return spec.target
