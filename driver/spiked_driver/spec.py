"""Sources by a line of text: `replay:FILE?pace=1&repeat=2&range=0:8000`, `sim:?seed=1&seconds=2`, `usb0?fov=40`, ..."""

import re
from typing import Annotated, Any, Literal, TypeVar
from urllib.parse import parse_qs

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, field_validator

from spiked.errors import SourceError
from spiked.recording import open_recording
from spiked.sensor import Intrinsics, Sensor
from spiked.simulate import MotionKind
from spiked_driver.fault_options import FaultOptions
from spiked_driver.faults import Faults, FaultySource
from spiked_driver.framing import USB_HEIGHT, USB_WIDTH
from spiked_driver.pcie import PCIE_SIZE, PcieSource
from spiked_driver.replay import ReplaySource
from spiked_driver.simulated import SimulatedSource
from spiked_driver.source import Source
from spiked_driver.usb import RATE_HZ, SILENCE_S, UsbOptions, UsbSource
from spiked_driver.usb_budget import TRANSFER_BYTES
from spiked_driver.usb_cameras import CameraChoice

Pace = Annotated[float, Field(ge=0), BeforeValidator(lambda value: 0.0 if value == "max" else value)]


class _Options(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class SourceOptions(FaultOptions):
    """Options of every source that is not a real camera: its pace, and what shall go wrong."""

    pace: Pace = 1.0
    """Factor of the sensor's frame rate; 0 or `max`: as fast as lossless consumers take frames."""


class ReplayOptions(SourceOptions):
    """Options of `replay:FILE`."""

    width: int | None = Field(None, gt=0)
    """Geometry and rate for a recording without a sidecar."""
    height: int | None = Field(None, gt=0)
    rate: float | None = Field(None, gt=0)
    """Frames a second."""
    repeat: int = Field(1, ge=1)
    range: tuple[int | None, int | None] = (None, None)
    """`first:stop` frames, either may be left out."""

    @field_validator("range", mode="before")
    @classmethod
    def _bounds(cls, value: Any) -> Any:
        return [part or None for part in value.split(":")] if isinstance(value, str) else value


class SimulationOptions(SourceOptions):
    """Options of `sim:`."""

    seed: int = 0
    seconds: float | None = Field(None, gt=0)
    """None: no end."""
    width: int = Field(320, gt=0)
    height: int = Field(180, gt=0)
    rate: float = Field(20_000.0, gt=0)
    """Frames a second."""
    motion: MotionKind = MotionKind.HAND_SHAKE
    flow_px: float = Field(0.12, gt=0)
    """Image motion a frame."""
    threads: int = Field(1, ge=1)
    """For the simulation; they change its speed, not its frames."""


class CameraOptions(_Options):
    """Options of every real camera."""

    rate: float = Field(RATE_HZ, gt=0)
    """Frames a second; the stream does not tell."""
    fov: float | None = Field(None, ge=1, le=170)
    """Horizontal field of view in degrees, for a pinhole camera with square pixels; without it optics are unknown."""

    def intrinsics(self, width: int, height: int) -> Intrinsics | None:
        """The optics, where known."""
        return None if self.fov is None else Intrinsics.from_fov(width, height, self.fov)


class UsbCameraOptions(CameraOptions):
    """Options of `usb0`, `usb:SERIAL` and `usb:BUS-PORT`."""

    hide_ms: float | None = Field(None, gt=0, le=10_000)
    """How long the host may be busy without a loss; not given: 250, or what the kernel's limit allows."""
    transfer_kib: int = Field(TRANSFER_BYTES >> 10, ge=16, le=16 << 10)
    transfers: Literal["queued", "single"] = "queued"
    """`single`: one read at a time, for machines where queued reads do not work."""
    silence_s: float = Field(SILENCE_S, gt=0)
    """When nothing came for so long, the camera is lost."""


_Kind = TypeVar("_Kind", bound=BaseModel)
_USB = re.compile(r"usb\d*(:|\?|$)")


def is_camera(spec: str) -> bool:
    """Whether the text names a real camera, which cannot wait and whose reader should not either."""
    return spec.startswith("pcie:") or _USB.match(spec) is not None


def open_source(spec: str) -> Source:
    """The source that a line of text names; `open` it to start. Raises SourceError or RecordingError in one line."""
    if _USB.match(spec):
        return _usb(spec)
    kind, separator, rest = spec.partition(":")
    if not separator:
        raise SourceError(f"source {spec!r} names no kind: write usb0, pcie:PATH, replay:FILE or sim:")
    target, _, query = rest.partition("?")
    source: Source
    match kind:
        case "pcie":
            if not target:
                raise SourceError(f"source {spec!r} names no path: write pcie:PATH, a device node, a pipe or a file")
            card = _parse(CameraOptions, query, spec)
            optics = card.intrinsics(PCIE_SIZE, PCIE_SIZE)
            return PcieSource(target, frame_rate_hz=card.rate, intrinsics=optics)
        case "replay":
            replay = _parse(ReplayOptions, query, spec)
            source = _replay(target, replay)
            faults = replay.faults(source.sensor.frame_rate_hz)
        case "sim":
            if target:
                raise SourceError(f"source {spec!r}: sim: takes options only, as in sim:?seed=1")
            simulation = _parse(SimulationOptions, query, spec)
            source = _simulated(simulation)
            faults = simulation.faults(simulation.rate)
        case _:
            raise SourceError(f"source {spec!r}: there is no kind {kind!r}, only usb0, pcie:PATH, replay:FILE and sim:")
    return source if faults == Faults(seed=faults.seed) else FaultySource(source, faults)


def _usb(spec: str) -> Source:
    target, _, query = spec.partition("?")
    options = _parse(UsbCameraOptions, query, spec)
    return UsbSource(
        CameraChoice.parse(target),
        UsbOptions(
            rate_hz=options.rate,
            intrinsics=options.intrinsics(USB_WIDTH, USB_HEIGHT),
            hide_s=None if options.hide_ms is None else options.hide_ms / 1e3,
            transfer_bytes=options.transfer_kib << 10,
            asynchronous=options.transfers == "queued",
            silence_s=options.silence_s,
        ),
    )


def _replay(path: str, options: ReplayOptions) -> Source:
    first, stop = options.range
    recording = open_recording(path, width=options.width, height=options.height, frame_rate_hz=options.rate)
    return ReplaySource(recording, pace=options.pace, repeat=options.repeat, first=first or 0, stop=stop)


def _simulated(options: SimulationOptions) -> Source:
    sensor = Sensor(options.width, options.height, options.rate)
    frames = None if options.seconds is None else round(options.seconds * options.rate)
    return SimulatedSource(
        sensor,
        seed=options.seed,
        motion=options.motion,
        flow_px=options.flow_px,
        frames=frames,
        pace=options.pace,
        threads=options.threads,
    )


def _parse(kind: type[_Kind], query: str, spec: str) -> _Kind:
    values = {
        name.replace("-", "_"): texts if len(texts) > 1 else texts[0]
        for name, texts in parse_qs(query, keep_blank_values=True).items()
    }
    try:
        return kind.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        where = first["loc"][0]
        if first["type"] == "extra_forbidden":
            raise SourceError(
                f"source {spec!r} has no option {where}: there are {', '.join(kind.model_fields)}"
            ) from error
        raise SourceError(f"source {spec!r}: option {where}={values[str(where)]}: {first['msg']}") from error
