"""What a camera is, as options: one definition for sources, profiles, uploads, requests and the command line.

Each option may be left out; what is stated wins over what a profile, a sidecar or the kind of camera says. The classes
accept text, as in `pcie:PATH?mosaic=BGGR&fov=50`; the models of requests that derive from them accept JSON types only.
"""

from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import (
    AliasChoices,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    Strict,
    StrictFloat,
    WithJsonSchema,
    model_validator,
)

from spiked.distortion import Distortion
from spiked.errors import ConfigurationError
from spiked.lens import Lens, distortion_of, lens_of
from spiked.sensor import BitOrder, Intrinsics, Layout, Mosaic, Response, Sensor

__all__ = [
    "CameraFiles",
    "CameraOptions",
    "LocalPath",
    "MosaicChoice",
    "Pinhole",
    "PinholeText",
    "Rate",
    "Side",
    "StoredCameraOptions",
]

MOST_HZ = 1e6
"""Upper bound of a frame rate: fifty times that of the first camera."""
MOST_SIDE = 1 << 14
"""Upper bound of width and height, pixels."""

Rate = Annotated[float, Field(ge=0.1, le=MOST_HZ)]
Side = Annotated[int, Field(ge=1, le=MOST_SIDE)]


LocalPath = Annotated[Path, Strict(False), WithJsonSchema({"type": "string", "minLength": 1, "maxLength": 4096})]
"""A path on this machine."""


def _none(value: object) -> bool:
    return value is None


class Pinhole(BaseModel):
    """A pinhole camera behind a lens; pixels, the centre of the first pixel is (0.5, 0.5)."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    fx: StrictFloat = Field(gt=0)
    fy: StrictFloat = Field(gt=0)
    cx: StrictFloat
    cy: StrictFloat
    distortion: Lens | None = Field(
        default=None, exclude_if=_none, description="Of the lens, as OpenCV has it; null: none."
    )

    def intrinsics(self) -> Intrinsics:
        """The same for the library."""
        return Intrinsics(self.fx, self.fy, self.cx, self.cy, distortion_of(self.distortion))

    @classmethod
    def of(cls, intrinsics: Intrinsics | None) -> Self | None:
        """The same from the library."""
        if intrinsics is None:
            return None
        k = intrinsics
        return cls(fx=k.fx, fy=k.fy, cx=k.cx, cy=k.cy, distortion=lens_of(k.distortion))


def _numbers(value: Any) -> Any:
    if not isinstance(value, str):
        return value
    parts = value.split(",")
    try:
        fx, fy, cx, cy = (float(part) for part in parts[:4])
    except ValueError as error:
        raise ValueError("it must be four numbers of pixels, fx,fy,cx,cy") from error
    try:
        lens = lens_of(Distortion.parse(",".join(parts[4:]))) if parts[4:] else None
    except ConfigurationError as error:
        raise ValueError(str(error)) from error
    return {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "distortion": lens}


PinholeText = Annotated[
    Pinhole,
    BeforeValidator(_numbers),
    WithJsonSchema({"type": "string", "pattern": r"^[^,]+(,[^,]+){3,8}$"}),
]
"""Intrinsics that are written `fx,fy,cx,cy`, with the distortion after them if there is any, see `Distortion.parse`."""


class MosaicChoice(StrEnum):
    """A mosaic, or detection from the pixels."""

    AUTO = "auto"
    RGGB = "RGGB"
    BGGR = "BGGR"
    GRBG = "GRBG"
    GBRG = "GBRG"

    @property
    def mosaic(self) -> Mosaic | None:
        """The mosaic that is stated; None: to be detected."""
        return None if self is MosaicChoice.AUTO else Mosaic(self)


class CameraOptions(BaseModel):
    """What neither the pixels nor the stream of a camera say."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True)

    rate: Rate | None = None
    """Frames per second."""
    mosaic: Annotated[Mosaic, Strict(False)] | None = None
    """Colour mosaic of the upright image; none: a grey sensor."""
    flipped: bool | None = Field(default=None, validation_alias=AliasChoices("flipped", "flip"))
    """Rows come bottom-up; false: top-down."""
    response: Annotated[Response, Strict(False)] | None = None
    """How light becomes spikes: integrate-and-fire of spike cameras, or bernoulli of single-photon cameras."""
    fov: float | None = Field(default=None, ge=1, le=170)
    """Horizontal field of view in degrees of a pinhole camera with square pixels; without optics they are estimated."""
    intrinsics: PinholeText | None = None
    """fx,fy,cx,cy in pixels, instead of a field of view; the first pixel's centre is (0.5, 0.5). Coefficients of the
    lens's distortion may follow: k1,k2,p1,p2,k3 or fisheye:k1,k2,k3,k4."""

    @model_validator(mode="after")
    def _one_kind_of_optics(self) -> Self:
        if self.fov is not None and self.intrinsics is not None:
            raise ValueError("fov and intrinsics both set the focal length; give one of them")
        return self

    def sensor(self, base: Sensor) -> Sensor:
        """`base` with what is stated here in place of its own. Raises ConfigurationError for an impossible sensor."""
        optics = base.intrinsics
        lens = None if optics is None else optics.distortion
        if self.intrinsics is not None:
            optics = self.intrinsics.intrinsics()
            optics = replace(optics, distortion=optics.distortion or lens)
        elif self.fov is not None:
            optics = Intrinsics.from_fov(base.width, base.height, self.fov, lens)
        return replace(
            base,
            frame_rate_hz=base.frame_rate_hz if self.rate is None else self.rate,
            mosaic=self.mosaic or base.mosaic,
            flipped=base.flipped if self.flipped is None else self.flipped,
            intrinsics=optics,
            response=self.response or base.response,
        )


class StoredCameraOptions(CameraOptions):
    """The same of frames that are stored, whose size and layout must be known, too."""

    width: Side | None = None
    """Pixels in a row, a multiple of 8."""
    height: Side | None = None
    """Rows."""
    layout: Annotated[Layout, Strict(False)] | None = None
    """How a frame is stored: rows only, or each row followed by its number."""
    bit_order: Annotated[BitOrder, Strict(False)] | None = None
    """Which bit of a byte is the leftmost of its eight pixels."""

    def sensor(self, base: Sensor) -> Sensor:
        """See `CameraOptions.sensor`. Of another size, the optics of `base` are dropped."""
        stated = {name: getattr(self, name) for name in ("width", "height", "layout", "bit_order")}
        changed = replace(base, **{name: value for name, value in stated.items() if value is not None})
        if (changed.width, changed.height) != (base.width, base.height):
            changed = replace(changed, intrinsics=None)
        return super().sensor(changed)


class CameraFiles(BaseModel):
    """Files on this machine that describe a camera."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    calibration: LocalPath | None = None
    """File of gains, dark rates and dead pixels, from `spiked calibrate`."""
    profile: LocalPath | None = None
    """Camera profile, a JSON file; options that are stated win over it."""
