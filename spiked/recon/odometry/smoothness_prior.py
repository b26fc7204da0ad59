"""Smoothness prior on the second differences of a spline's knots.

Between views farther apart than the knots (a stationary camera, a gap) no observation constrains the knots, and an
adjustment lets them oscillate. The prior's scale is the RMS of the second differences where views constrain them; next
to hundreds of tracks it is negligible.
"""

from dataclasses import dataclass

import numpy as np

from spiked.pose import Array, log_so3
from spiked.spline import Spline

MIN_CONSTRAINED_WEIGHT = 0.5
"""Sum of a knot's basis weights over the views from which on the views constrain it."""
CONSTRAINED_SIGMA = 3.0
"""Standard deviation of constrained second differences, relative to their RMS."""
UNCONSTRAINED_SIGMA = 0.3
"""The same for unconstrained ones: smaller, as correlated track errors weaken the observations around them."""
MIN_SIGMA = 1e-6
"""Floor of the standard deviation (rad, and units of depth)."""


@dataclass(frozen=True)
class SmoothnessPrior:
    """The prior of one spline with k knots; energies are in px^2, as sums of squared residuals of tracks."""

    differences: Array  # [k - 2, k]
    weights: Array  # [k - 2, 6], of (rotation, centre)

    @classmethod
    def of(cls, spline: Spline, blend: Array, noise_px: float) -> "SmoothnessPrior":
        """For a spline seen by views with basis weights `blend` [views, k] and tracks with this noise."""
        supported = blend.sum(0) >= MIN_CONSTRAINED_WEIGHT
        constrained = supported[:-2] & supported[1:-1] & supported[2:]
        second = _second_differences(spline)
        seen = second[constrained] if constrained.sum() >= 3 else second
        size = np.repeat([np.sqrt((part**2).mean()) if len(part) else 0.0 for part in (seen[:, :3], seen[:, 3:])], 3)
        differences = np.diff(np.eye(blend.shape[1]), 2, axis=0)
        allowed = np.where(constrained, CONSTRAINED_SIGMA, UNCONSTRAINED_SIGMA)[:, None] * size
        return cls(differences, np.asarray(max(noise_px, 1e-3) ** 2 / (allowed**2 + MIN_SIGMA**2)))

    def energy(self, spline: Spline) -> float:
        """Half the weighted squares of the second differences."""
        return float(0.5 * (_second_differences(spline) ** 2 * self.weights).sum())

    def hessian(self) -> Array:
        """[k, 6, k, 6], for knots perturbed on the left."""
        blocks = np.einsum("ma,mi,mb->iab", self.differences, self.weights, self.differences, optimize=True)
        out = np.zeros((blocks.shape[1], 6, blocks.shape[2], 6))
        out[:, np.arange(6), :, np.arange(6)] = blocks
        return out

    def gradient(self, spline: Spline) -> Array:
        """Of the energy, [k, 6]."""
        return np.asarray(self.differences.T @ (_second_differences(spline) * self.weights))


def _second_differences(spline: Spline) -> Array:
    """How much the step from knot to knot changes, [k - 2, 6] in world axes."""
    turns = log_so3(spline.rotations[1:] @ spline.rotations[:-1].swapaxes(1, 2))
    return np.concatenate([np.diff(turns, axis=0), np.diff(spline.centres, 2, axis=0)], 1)
