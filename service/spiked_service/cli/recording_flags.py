"""Options that describe a recording without a sidecar, for every command that opens one."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from pydantic import BaseModel, ValidationError

from spiked.calibration import Calibration
from spiked.camera import CameraFiles, MosaicChoice, Pinhole, StoredCameraOptions
from spiked.distortion import Distortion
from spiked.errors import ConfigurationError
from spiked.profile import CameraProfile
from spiked.recording import Recording, RecordingGeometry, open_recording, recorded_calibration, sidecar_path
from spiked.sensor import BitOrder, Intrinsics, Layout, Mosaic, Response, Sensor

_PANEL = "Geometry of a recording without a sidecar"


def _flag(name: str, *flags: str, panel: str = _PANEL, **more: Any) -> Any:
    """A flag with description and bounds of the field of `StoredCameraOptions` or `CameraFiles`."""
    fields = StoredCameraOptions.model_fields | CameraFiles.model_fields
    return typer.Option(*flags, help=fields[name].description, rich_help_panel=panel, **more)


Width = Annotated[int | None, _flag("width", "--width")]
Height = Annotated[int | None, _flag("height", "--height")]
Rate = Annotated[float | None, _flag("rate", "--rate")]
Profile = Annotated[Path | None, _flag("profile", "--profile", panel="Camera")]
CalibrationFile = Annotated[Path | None, _flag("calibration", "--calibration", panel="Camera")]


def parse_layout(text: str) -> Layout:
    """`row-tagged` is read as `row_tagged`."""
    try:
        return Layout(text)
    except ValueError as error:
        raise typer.BadParameter(f"{text!r} is not one of {', '.join(Layout)}") from error


FrameLayout = Annotated[
    Layout | None,
    _flag("layout", "--layout", parser=parse_layout, metavar=f"<{'|'.join(Layout)}>"),
]
Bits = Annotated[BitOrder | None, _flag("bit_order", "--bit-order")]
Flipped = Annotated[bool | None, _flag("flipped", "--flipped/--upright")]
SensorResponse = Annotated[Response | None, _flag("response", "--response")]
Colours = Annotated[Mosaic | None, _flag("mosaic", "--mosaic")]


ColoursOrAuto = Annotated[
    MosaicChoice | None,
    typer.Option(
        "--mosaic", help="Colour mosaic of the upright image; auto: detect it from the pixels.", rich_help_panel=_PANEL
    ),
]
Fov = Annotated[float | None, _flag("fov", "--fov", panel="Optics")]
IntrinsicsText = Annotated[
    str | None,
    typer.Option(
        "--intrinsics",
        help="fx,fy,cx,cy in pixels, or the .json file of `spiked calibrate --board`.",
        metavar="FX,FY,CX,CY",
        rich_help_panel="Optics",
    ),
]
DistortionText = Annotated[
    str | None,
    typer.Option(
        "--distortion",
        help="Distortion of the lens, as OpenCV has it: k1,k2,p1,p2,k3, or fisheye:k1,k2,k3,k4; those left out at the "
        "end are 0. none: of a lens without.",
        metavar="K1,K2,...",
        rich_help_panel="Optics",
    ),
]


@dataclass(frozen=True)
class OpticsFlags:
    """Optics, for `with_optics`."""

    fov: Fov = None
    intrinsics: IntrinsicsText = None
    distortion: DistortionText = None

    def of(self, sensor: Sensor) -> Sensor:
        """The sensor with these optics, or its own if none are given. Raises ConfigurationError."""
        return with_optics(sensor, self.fov, self.intrinsics, self.distortion)


@dataclass(frozen=True)
class _LayoutFlags:
    width: Width = None
    height: Height = None
    rate: Rate = None
    layout: FrameLayout = None
    bit_order: Bits = None
    flipped: Flipped = None


@dataclass(frozen=True)
class GeometryFlags(_LayoutFlags):
    """Geometry of a recording without a sidecar."""

    mosaic: Colours = None
    response: SensorResponse = None

    def stated(self) -> RecordingGeometry:
        """What is given."""
        return _geometry(self, self.mosaic, self.response)


@dataclass(frozen=True)
class DetectableGeometryFlags(_LayoutFlags):
    """`GeometryFlags` with a mosaic that can be detected."""

    mosaic: ColoursOrAuto = None
    response: SensorResponse = None

    @property
    def detects(self) -> bool:
        """Whether the mosaic is to be detected."""
        return self.mosaic is MosaicChoice.AUTO

    def stated(self) -> RecordingGeometry:
        """What is given."""
        return _geometry(self, None if self.mosaic is None else self.mosaic.mosaic, self.response)


def _geometry(of: _LayoutFlags, mosaic: Mosaic | None, response: Response | None) -> RecordingGeometry:
    return RecordingGeometry(
        of.width, of.height, of.rate, of.layout, of.bit_order, of.flipped, mosaic, response=response
    )


@dataclass(frozen=True)
class DescribedRecording:
    """A recording with what options and profile say of its camera."""

    recording: Recording
    geometry: RecordingGeometry
    """What options and profile state, by which `open_recording` opens it again."""
    calibration: Path | None
    """The profile's, else the sidecar's."""


def open_described(file: Path, stated: RecordingGeometry, profile: Path | None) -> DescribedRecording:
    """Open a recording by what is stated, then by the profile, then by its sidecar.

    Raises RecordingError, and ProfileError for a profile of another camera.
    """
    calibration = recorded_calibration(file)
    if profile is None:
        return DescribedRecording(open_recording(file, **stated.stated()), stated, calibration)
    known = CameraProfile.read(profile)
    given = {name: getattr(stated, field) for name, field in _FIELDS.items() if getattr(stated, field) is not None}
    options = known.completed(StoredCameraOptions.model_validate(given), size=not sidecar_path(file).exists())
    geometry = RecordingGeometry.of(options)
    recording = open_recording(file, **geometry.stated())
    known.check(recording.sensor)
    recording = replace(recording, sensor=options.sensor(recording.sensor))
    if known.calibration is not None:
        calibration = profile.parent / known.calibration
    return DescribedRecording(recording, replace(geometry, intrinsics=recording.sensor.intrinsics), calibration)


def read_calibration(given: Path | None, described: DescribedRecording) -> Calibration | None:
    """The calibration that is given, else the recording's. Raises CalibrationError."""
    path = given or described.calibration
    return None if path is None else Calibration.read(path)


_FIELDS = {
    "width": "width",
    "height": "height",
    "rate": "frame_rate_hz",
    "layout": "layout",
    "bit_order": "bit_order",
    "flipped": "flipped",
    "mosaic": "mosaic",
    "response": "response",
}
"""Options of a camera, and the fields of `RecordingGeometry`."""


def with_optics(sensor: Sensor, fov_deg: float | None, intrinsics: str | None, distortion: str | None = None) -> Sensor:
    """The sensor with the optics given, or its own if none are. Raises ConfigurationError.

    A new focal length keeps the sensor's distortion: that is a function of angles.
    """
    if fov_deg is not None and intrinsics is not None:
        raise ConfigurationError("--fov and --intrinsics both set the focal length; give one of them")
    own = sensor.intrinsics
    lens = None if own is None else own.distortion
    if intrinsics is not None:
        own = parse_intrinsics(intrinsics)
        lens = own.distortion or lens
    if distortion is not None:
        lens = Distortion.parse(distortion)
    if fov_deg is not None:
        own = Intrinsics.from_fov(sensor.width, sensor.height, fov_deg, lens)
    if own is None:
        if lens is not None:
            raise ConfigurationError("--distortion needs the focal length: give --fov or --intrinsics, too")
        return sensor
    return replace(sensor, intrinsics=replace(own, distortion=lens))


def parse_intrinsics(text: str) -> Intrinsics:
    """From `fx,fy,cx,cy`, or the file of `spiked calibrate --board`. Raises ConfigurationError."""
    if text.endswith(".json"):
        return _measured(Path(text))
    try:
        fx, fy, cx, cy = (float(part) for part in text.split(","))
    except ValueError as error:
        raise ConfigurationError(f"--intrinsics {text!r} is not four numbers: write fx,fy,cx,cy in pixels") from error
    if not (fx > 0 and fy > 0 and np.isfinite([fx, fy, cx, cy]).all()):
        raise ConfigurationError(f"--intrinsics {text!r}: give finite numbers of pixels, and positive focal lengths")
    return Intrinsics(fx, fy, cx, cy)


class _Measured(BaseModel):
    intrinsics: Pinhole


def _measured(path: Path) -> Intrinsics:
    try:
        return _Measured.model_validate_json(path.read_bytes()).intrinsics.intrinsics()
    except OSError as error:
        raise ConfigurationError(f"--intrinsics {path}: the file cannot be read: {error.strerror}") from error
    except ValidationError as error:
        raise ConfigurationError(
            f"--intrinsics {path}: not a file of `spiked calibrate --board`: {error.errors()[0]['msg']}"
        ) from error
