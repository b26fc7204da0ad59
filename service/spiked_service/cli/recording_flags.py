"""Options that describe a recording without a sidecar, for every command that opens one."""

from dataclasses import replace
from enum import StrEnum
from typing import Annotated

import numpy as np
import typer

from spiked.errors import ConfigurationError
from spiked.sensor import BitOrder, Intrinsics, Layout, Mosaic, Sensor

_PANEL = "Geometry of a recording without a sidecar"

Width = Annotated[int | None, typer.Option(help="Width in pixels; a multiple of 8.", rich_help_panel=_PANEL)]
Height = Annotated[int | None, typer.Option(help="Height in pixels.", rich_help_panel=_PANEL)]
Rate = Annotated[float | None, typer.Option("--rate", help="Frame rate in Hz.", rich_help_panel=_PANEL)]


def parse_layout(text: str) -> Layout:
    """`row-tagged` is read as `row_tagged`."""
    try:
        return Layout(text)
    except ValueError as error:
        raise typer.BadParameter(f"{text!r} is not one of {', '.join(Layout)}") from error


FrameLayout = Annotated[
    Layout | None,
    typer.Option(
        "--layout",
        help="Storage of a frame.",
        parser=parse_layout,
        metavar=f"<{'|'.join(Layout)}>",
        rich_help_panel=_PANEL,
    ),
]
Bits = Annotated[
    BitOrder | None,
    typer.Option("--bit-order", help="Which bit of a byte is its leftmost pixel.", rich_help_panel=_PANEL),
]
Flipped = Annotated[
    bool | None, typer.Option("--flipped/--upright", help="Rows stored bottom-up or top-down.", rich_help_panel=_PANEL)
]
Colours = Annotated[
    Mosaic | None, typer.Option("--mosaic", help="Colour mosaic of the upright image.", rich_help_panel=_PANEL)
]


class MosaicChoice(StrEnum):
    """A mosaic, or detection from the pixels."""

    AUTO = "auto"
    RGGB = "RGGB"
    BGGR = "BGGR"
    GRBG = "GRBG"
    GBRG = "GBRG"


ColoursOrAuto = Annotated[
    MosaicChoice | None,
    typer.Option(
        "--mosaic", help="Colour mosaic of the upright image; auto: detect it from the pixels.", rich_help_panel=_PANEL
    ),
]
Fov = Annotated[
    float | None, typer.Option("--fov", help="Horizontal field of view in degrees.", rich_help_panel="Optics")
]
IntrinsicsText = Annotated[
    str | None,
    typer.Option("--intrinsics", help="fx,fy,cx,cy in pixels.", metavar="FX,FY,CX,CY", rich_help_panel="Optics"),
]


def with_optics(sensor: Sensor, fov_deg: float | None, intrinsics: str | None) -> Sensor:
    """The sensor with the optics given, or its own if none are. Raises ConfigurationError."""
    if fov_deg is not None and intrinsics is not None:
        raise ConfigurationError("--fov and --intrinsics both set the focal length; give one of them")
    if fov_deg is not None:
        return replace(sensor, intrinsics=Intrinsics.from_fov(sensor.width, sensor.height, fov_deg))
    return sensor if intrinsics is None else replace(sensor, intrinsics=parse_intrinsics(intrinsics))


def parse_intrinsics(text: str) -> Intrinsics:
    """From `fx,fy,cx,cy`. Raises ConfigurationError."""
    try:
        fx, fy, cx, cy = (float(part) for part in text.split(","))
    except ValueError as error:
        raise ConfigurationError(f"--intrinsics {text!r} is not four numbers: write fx,fy,cx,cy in pixels") from error
    if not (fx > 0 and fy > 0 and np.isfinite([fx, fy, cx, cy]).all()):
        raise ConfigurationError(f"--intrinsics {text!r}: give finite numbers of pixels, and positive focal lengths")
    return Intrinsics(fx, fy, cx, cy)
