"""Distortion of a lens: OpenCV's polynomial model and its fisheye model.

A lens bends slopes: a point at (x, y, z) in camera axes is seen at (fx x' + cx, fy y' + cy), where (x', y') are the
bent slopes (x/z, y/z). Formulas: OpenCV's documentation of `calib3d` and of `fisheye`; J. Kannala and S. Brandt, "A
generic camera model and calibration method for conventional, wide-angle, and fish-eye lenses", PAMI 2006.
"""

from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from spiked.errors import ConfigurationError

__all__ = ["Distortion", "LensModel"]

Array = NDArray[np.float64]

WIDEST_DEG = 85.0
"""Largest angle to the optical axis that a lens shows: the slope of 90 degrees is infinite."""
MOST_COEFFICIENT = 1000.0
"""Coefficients beyond are refused: only lenses of a very narrow field have some above 10."""
LEAST_REACH = 0.02
"""A lens that images only slopes below this, 1 degree, is refused: its coefficients are wrong."""
FITTED_SLOPES = 100
"""Slopes at which a lens is fitted to one of another model."""
NEWTON_STEPS, NEWTON_TOLERANCE = 30, 1e-12
"""Most steps of the inverse, and the largest slope error that ends it."""


class LensModel(StrEnum):
    """A formula of distortion, by its name in sidecars and requests."""

    OPENCV = "opencv"
    """Radial k1 k2 k3 in even powers of the slope, and tangential p1 p2."""
    FISHEYE = "fisheye"
    """The angle to the axis with k1 to k4 in its even powers, in place of the slope."""

    @property
    def names(self) -> tuple[str, ...]:
        """The coefficients in OpenCV's order."""
        return ("k1", "k2", "p1", "p2", "k3") if self is LensModel.OPENCV else ("k1", "k2", "k3", "k4")


@dataclass(frozen=True)
class Distortion:
    """A model with its `coefficients`, in the order of `LensModel.names`. Trailing ones that are left out are 0."""

    model: LensModel
    coefficients: tuple[float, ...]

    def __post_init__(self) -> None:
        names = self.model.names
        given = tuple(float(value) for value in self.coefficients)
        if len(given) > len(names):
            raise ConfigurationError(
                f"{len(given)} coefficients of distortion are too many: the {self.model} model has {', '.join(names)}"
            )
        given += (0.0,) * (len(names) - len(given))
        if not all(abs(value) <= MOST_COEFFICIENT for value in given):
            raise ConfigurationError(
                f"distortion {', '.join(f'{value:g}' for value in given)}: coefficients are finite and "
                f"at most {MOST_COEFFICIENT:g} in size"
            )
        object.__setattr__(self, "coefficients", given)
        if self.reach < LEAST_REACH:
            raise ConfigurationError(
                f"distortion {', '.join(f'{n} = {v:g}' for n, v in zip(names, given, strict=True))} folds the image "
                f"{np.degrees(np.arctan(self.reach)):.1f} degrees from its axis: check the order, {', '.join(names)}"
            )

    def named(self) -> dict[str, float]:
        """The coefficients by name."""
        return dict(zip(self.model.names, self.coefficients, strict=True))

    @classmethod
    def of(cls, model: LensModel, named: dict[str, float]) -> "Distortion":
        """From coefficients by name; those left out are 0. Raises ConfigurationError for a name of the other model."""
        for name in named:
            if name not in model.names:
                raise ConfigurationError(f"the {model} model has no {name}: it has {', '.join(model.names)}")
        return cls(model, tuple(named.get(name, 0.0) for name in model.names))

    @classmethod
    def parse(cls, text: str) -> "Distortion | None":
        """From `k1,k2,p1,p2,k3` or `fisheye:k1,k2,k3,k4`, those at the end may be left out; None for `none`.

        Raises ConfigurationError.
        """
        if text == "none":
            return None
        head, colon, rest = text.rpartition(":")
        model = LensModel.OPENCV if not colon else next((m for m in LensModel if m == head), None)
        if model is None:
            raise ConfigurationError(f"distortion {text!r}: {head!r} is no model of a lens: {', '.join(LensModel)}")
        try:
            values = tuple(float(part) for part in rest.split(",") if part.strip())
        except ValueError as error:
            raise ConfigurationError(f"distortion {text!r} is not numbers: write {','.join(model.names)}") from error
        return cls(model, values)

    @cached_property
    def reach(self) -> float:
        """The largest slope that is imaged: beyond, a polynomial turns back and would fold the image."""
        widest = float(np.tan(np.radians(WIDEST_DEG)))
        slopes = np.tan(np.radians(np.linspace(0, WIDEST_DEG, 2000)))
        scale, growth = self._radial(slopes**2)
        folded = scale + 2 * slopes**2 * growth <= 0
        return float(slopes[max(int(np.argmax(folded)) - 1, 0)]) if folded.any() else widest

    def _radial(self, square: Array) -> tuple[Array, Array]:
        """The factor of a slope by its square r^2, and the factor's derivative by r^2."""
        if self.model is LensModel.OPENCV:
            k1, k2, _, _, k3 = self.coefficients
            scale = 1 + square * (k1 + square * (k2 + square * k3))
            return scale, k1 + square * (2 * k2 + 3 * square * k3)
        k1, k2, k3, k4 = self.coefficients
        r = np.sqrt(np.maximum(square, 1e-10))
        angle = np.arctan(r)
        t = angle**2
        bent = angle * (1 + t * (k1 + t * (k2 + t * (k3 + t * k4))))
        by_angle = 1 + t * (3 * k1 + t * (5 * k2 + t * (7 * k3 + t * 9 * k4)))
        return bent / r, np.asarray((by_angle / (1 + r * r) - bent / r) / (2 * r * r))

    def bend(self, slopes: Array) -> Array:
        """Bent slopes [..., 2]; slopes beyond `reach` are bent as those at it."""
        inside = self._limited(slopes)
        x, y = inside[..., 0], inside[..., 1]
        square = x * x + y * y
        scale, _ = self._radial(square)
        out = inside * scale[..., None]
        if self.model is LensModel.OPENCV:
            p1, p2 = self.coefficients[2:4]
            out[..., 0] += 2 * p1 * x * y + p2 * (square + 2 * x * x)
            out[..., 1] += p1 * (square + 2 * y * y) + 2 * p2 * x * y
        return np.asarray(out)

    def derivative(self, slopes: Array) -> Array:
        """Derivative [..., 2, 2] of bent slopes by slopes [..., 2]. It is symmetric."""
        inside = self._limited(slopes)
        x, y = inside[..., 0], inside[..., 1]
        scale, growth = self._radial(x * x + y * y)
        p1, p2 = self.coefficients[2:4] if self.model is LensModel.OPENCV else (0.0, 0.0)
        mixed = 2 * x * y * growth + 2 * p1 * x + 2 * p2 * y
        rows = [scale + 2 * x * x * growth + 2 * p1 * y + 6 * p2 * x, mixed]
        rows += [mixed, scale + 2 * y * y * growth + 6 * p1 * y + 2 * p2 * x]
        return np.stack(rows, -1).reshape(*x.shape, 2, 2)

    def by_radial(self, slopes: Array) -> Array:
        """Derivative [..., 2, 2] of bent slopes by k1 and k2, at slopes [..., 2]."""
        inside = self._limited(slopes)
        square = np.maximum((inside**2).sum(-1), 1e-10)
        first = next_ = square
        if self.model is LensModel.FISHEYE:
            angle = np.arctan(np.sqrt(square))
            first, next_ = angle**3 / np.sqrt(square), angle**2
        return np.asarray(inside[..., None] * np.stack([first, first * next_], -1)[..., None, :])

    def as_model(self, model: LensModel, widest: float) -> "Distortion":
        """k1 and k2 of a model that bends slopes up to `widest` as nearly like this one as it can.

        Raises ConfigurationError if that folds the image.
        """
        slopes = np.stack([np.linspace(0, min(widest, self.reach), FITTED_SLOPES)[1:], np.zeros(FITTED_SLOPES - 1)], -1)
        plain = Distortion(model, ())
        rows = plain.by_radial(slopes)[:, 0]
        return Distortion(model, tuple(np.linalg.lstsq(rows, (self.bend(slopes) - plain.bend(slopes))[:, 0])[0]))

    def straighten(self, bent: Array) -> Array:
        """Slopes [..., 2] whose bent slopes are given, by Newton's method; at most `reach` long."""
        bent = np.asarray(bent, np.float64)
        slopes = self._limited(bent.copy())
        for _ in range(NEWTON_STEPS):
            error = self.bend(slopes) - bent
            d = self.derivative(slopes)
            a, b, c = d[..., 0, 0], d[..., 0, 1], d[..., 1, 1]
            determinant = np.maximum(a * c - b * b, 1e-9)
            step = np.stack([c * error[..., 0] - b * error[..., 1], a * error[..., 1] - b * error[..., 0]], -1)
            moved = self._limited(slopes - step / determinant[..., None])
            change = float(np.abs(moved - slopes).max(initial=0))
            slopes = moved
            if change < NEWTON_TOLERANCE:
                break
        return slopes

    def _limited(self, slopes: Array) -> Array:
        """Slopes [..., 2], those longer than `reach` shortened to it."""
        length = np.linalg.norm(slopes, axis=-1, keepdims=True)
        return np.asarray(slopes * np.minimum(1, self.reach / np.maximum(length, 1e-12)))

    def arguments(self) -> Array:
        """For compiled functions, [7]: 1 (OpenCV) or 2 (fisheye), five coefficients, and the square of `reach`."""
        padded = (*self.coefficients, 0.0)[:5]
        return np.array([1.0 if self.model is LensModel.OPENCV else 2.0, *padded, self.reach**2])

    def __str__(self) -> str:
        return ", ".join([str(self.model), *(f"{name} {value:g}" for name, value in self.named().items())])
