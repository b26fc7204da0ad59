"""The options that say what a recording without a sidecar holds, for every command that opens one."""

from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from spiked.errors import ConfigurationError
from spiked.recording import Recording, open_recording
from spiked.sensor import BitOrder, Intrinsics, Layout, Mosaic, Sensor

_PANEL = "Geometry, where no sidecar says it"

Width = Annotated[int | None, typer.Option(help="Pixels in a row.", rich_help_panel=_PANEL)]
Height = Annotated[int | None, typer.Option(help="Rows.", rich_help_panel=_PANEL)]
Rate = Annotated[float | None, typer.Option("--rate", help="Frames a second.", rich_help_panel=_PANEL)]
FrameLayout = Annotated[Layout | None, typer.Option("--layout", help="How a frame is stored.", rich_help_panel=_PANEL)]
Bits = Annotated[BitOrder | None, typer.Option("--bit-order", help="Leftmost pixel of a byte.", rich_help_panel=_PANEL)]
Flipped = Annotated[
    bool | None, typer.Option("--flipped/--upright", help="Rows stored bottom-up or top-down.", rich_help_panel=_PANEL)
]
Colours = Annotated[
    Mosaic | None, typer.Option("--mosaic", help="Colour mosaic of the upright image.", rich_help_panel=_PANEL)
]


class MosaicChoice(StrEnum):
    """A mosaic, or what the pixels tell."""

    AUTO = "auto"
    RGGB = "RGGB"
    BGGR = "BGGR"
    GRBG = "GRBG"
    GBRG = "GBRG"


ColoursOrAuto = Annotated[
    MosaicChoice | None,
    typer.Option("--mosaic", help="Colour mosaic of the upright image; auto: by the pixels.", rich_help_panel=_PANEL),
]
Fov = Annotated[
    float | None, typer.Option("--fov", help="Horizontal field of view, degrees.", rich_help_panel="Optics")
]
IntrinsicsText = Annotated[
    str | None,
    typer.Option("--intrinsics", help="fx,fy,cx,cy in pixels.", metavar="FX,FY,CX,CY", rich_help_panel="Optics"),
]


@dataclass(frozen=True)
class Geometry:
    """What the user said of a recording; None leaves it to the sidecar or to the size of the file."""

    width: int | None = None
    height: int | None = None
    frame_rate_hz: float | None = None
    layout: Layout | None = None
    bit_order: BitOrder | None = None
    flipped: bool | None = None
    mosaic: Mosaic | None = None

    def open(self, path: Path) -> Recording:
        """Open a recording with it. Raises RecordingError or ConfigurationError."""
        return open_recording(
            path,
            width=self.width,
            height=self.height,
            frame_rate_hz=self.frame_rate_hz,
            layout=self.layout,
            bit_order=self.bit_order,
            flipped=self.flipped,
            mosaic=self.mosaic,
        )


def with_optics(sensor: Sensor, fov_deg: float | None, intrinsics: str | None) -> Sensor:
    """The sensor with the optics given, or its own if none are. Raises ConfigurationError."""
    if fov_deg is not None and intrinsics is not None:
        raise ConfigurationError("--fov and --intrinsics both say the focal length; give one of them")
    if fov_deg is not None:
        return replace(sensor, intrinsics=Intrinsics.from_fov(sensor.width, sensor.height, fov_deg))
    return sensor if intrinsics is None else replace(sensor, intrinsics=parse_intrinsics(intrinsics))


def parse_intrinsics(text: str) -> Intrinsics:
    """From `fx,fy,cx,cy`. Raises ConfigurationError."""
    try:
        fx, fy, cx, cy = (float(part) for part in text.split(","))
    except ValueError as error:
        raise ConfigurationError(f"--intrinsics {text!r} is not four numbers: write fx,fy,cx,cy in pixels") from error
    if not (fx > 0 and fy > 0):
        raise ConfigurationError(f"--intrinsics {text!r}: focal lengths are positive numbers of pixels")
    return Intrinsics(fx, fy, cx, cy)
