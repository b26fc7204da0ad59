"""Distortion of a lens in sidecars, profiles, requests and answers."""

from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, StrictFloat, model_validator

from spiked.distortion import MOST_COEFFICIENT, Distortion, LensModel
from spiked.errors import ConfigurationError

__all__ = ["FisheyeLens", "Lens", "OpencvLens", "distortion_of", "lens_of"]

Coefficient = Annotated[StrictFloat, Field(ge=-MOST_COEFFICIENT, le=MOST_COEFFICIENT)]


class _Lens(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @model_validator(mode="after")
    def _possible(self) -> Self:
        try:
            self.distortion()
        except ConfigurationError as error:
            raise ValueError(str(error)) from error
        return self

    def distortion(self) -> Distortion:
        """As of a camera."""
        named = self.model_dump()
        return Distortion.of(LensModel(named.pop("model")), named)


class OpencvLens(_Lens):
    """Distortion by OpenCV's polynomial: radial k1, k2, k3 and tangential p1, p2."""

    model: Literal[LensModel.OPENCV]
    k1: Coefficient = 0.0
    k2: Coefficient = 0.0
    p1: Coefficient = 0.0
    p2: Coefficient = 0.0
    k3: Coefficient = 0.0


class FisheyeLens(_Lens):
    """Distortion by OpenCV's fisheye model."""

    model: Literal[LensModel.FISHEYE]
    k1: Coefficient = 0.0
    k2: Coefficient = 0.0
    k3: Coefficient = 0.0
    k4: Coefficient = 0.0


Lens = Annotated[OpencvLens | FisheyeLens, Field(discriminator="model")]
"""Distortion by one of the models."""


def lens_of(distortion: Distortion | None) -> OpencvLens | FisheyeLens | None:
    """That of a camera."""
    if distortion is None:
        return None
    if distortion.model is LensModel.OPENCV:
        return OpencvLens(model=LensModel.OPENCV, **distortion.named())
    return FisheyeLens(model=LensModel.FISHEYE, **distortion.named())


def distortion_of(lens: OpencvLens | FisheyeLens | None) -> Distortion | None:
    """As of a camera; None for none."""
    return None if lens is None else lens.distortion()
