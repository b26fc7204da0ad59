"""Sources by a line of text: `replay:FILE?pace=1&repeat=2&range=0:8000`, `sim:?seed=1&seconds=2`, `usb0?fov=40`, ...

The kinds are in `source_kinds`, and each checks its options: a source that `open_source` returns can be captured from.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar
from urllib.parse import parse_qs

from pydantic import BaseModel, ValidationError

from spiked.calibration import Calibration
from spiked.errors import SourceError
from spiked.profile import CameraProfile, find_profile
from spiked.recording import recorded_calibration, sidecar_path
from spiked.recording.geometry import Assumable
from spiked_driver.fault_options import FaultOptions
from spiked_driver.faults import Faults, FaultySource
from spiked_driver.source import Source
from spiked_driver.source_kind import Device, SourceOptions, SourceSpec, Warn
from spiked_driver.source_kinds import kind_of

MOST_PIXELS = 1 << 22
"""Upper bound of a frame's pixels: four times those of the largest camera."""

_Options = TypeVar("_Options", bound=BaseModel)


@dataclass(frozen=True)
class OpenedCamera:
    """A source, and what was known of its camera."""

    source: Source
    profile: CameraProfile | None = None
    """The profile that completed the options of the source's text."""
    calibration: Path | None = None
    """File of gains, dark rates and dead pixels; it fits the sensor."""
    assumed: tuple[Assumable, ...] = ()
    """Properties of the sensor that neither the options nor a profile nor the source state."""


def open_source(spec: str, warn: Warn | None = None) -> Source:
    """The source that a line of text names; `open` it to start. Raises SpikedError in one line.

    `warn` gets one sentence for each fault that the capture survives.
    """
    return open_camera(spec, warn).source


def open_camera(spec: str, warn: Warn | None = None, profiles: Path | None = None) -> OpenedCamera:
    """As `open_source`, with what is known of the camera.

    What its options do not state is taken from the profile that they name, else from that in the folder `profiles`
    which is named after the camera's serial number or address. Raises SourceError, RecordingError, ProfileError or
    CalibrationError in one line.
    """
    kind, parts = kind_of(spec), SourceSpec.parse(spec)
    options = _parse(kind.options, parts.query, spec)
    path = profile = calibration = None
    recording = kind.recording_of(parts)
    if isinstance(options, SourceOptions):
        path = options.profile or (None if profiles is None else stored_profile(kind.describe(parts), profiles))
        if path is not None:
            profile = CameraProfile.read(path)
            options = profile.completed(options, size=recording is None or not sidecar_path(recording).exists())
        calibration = options.calibration
    _check_size(options, spec)
    source = kind.open(parts, options, warn)
    assumed = kind.assumed(source, options)
    if profile is not None and path is not None:
        profile.check(source.sensor)
        if calibration is None and profile.calibration is not None:
            calibration = path.parent / profile.calibration
    if calibration is None and recording is not None:
        calibration = recorded_calibration(recording)
    if calibration is not None:
        Calibration.read(calibration).check(source.sensor)
    if isinstance(options, FaultOptions):
        faults = options.faults(source.sensor.frame_rate_hz)
        source = source if faults == Faults(seed=faults.seed) else FaultySource(source, faults)
    return OpenedCamera(source, profile, calibration, assumed)


def stored_profile(device: Device, profiles: Path) -> Path | None:
    """The profile of the device: by its serial number, by its address, or by its port however it is addressed."""
    found = find_profile(profiles, SourceSpec.parse(device.source).address, device.serial)
    if found is None and device.port is not None:
        found = find_profile(profiles, f"{device.kind}:{device.port}", None)
    return found


def _parse(kind: type[_Options], query: str, spec: str) -> _Options:
    values = {
        name.replace("-", "_"): texts if len(texts) > 1 else texts[0]
        for name, texts in parse_qs(query, keep_blank_values=True).items()
    }
    try:
        options = kind.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        where = str(first["loc"][0]) if first["loc"] else None
        if first["type"] == "extra_forbidden":
            raise SourceError(
                f"source {spec!r} has no option {where}: there are {', '.join(kind.model_fields)}"
            ) from error
        problem = first["msg"].removeprefix("Value error, ").replace("Input should be", "it must be")
        named = "" if where is None else f"option {where}={values.get(where, '')}: "
        raise SourceError(f"source {spec!r}: {named}{problem}") from error
    return options


def _check_size(options: BaseModel, spec: str) -> None:
    """Raises SourceError for frames that no memory holds."""
    width, height = getattr(options, "width", None) or 1, getattr(options, "height", None) or 1
    if width * height > MOST_PIXELS:
        raise SourceError(
            f"source {spec!r}: frames of {width}x{height} are larger than {MOST_PIXELS} pixels: choose smaller ones"
        )
