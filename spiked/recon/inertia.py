"""What holds a spline where no view does: a camera goes on as it went.

Between views that lie farther apart than the knots (a camera that stood still, a gap) nothing else says where the
knots are, and an adjustment lets them swing. Second differences of neighbouring knots are weighed by how large they
are where views tell: next to hundreds of tracks that is nothing, and without them it is all there is.
"""

from dataclasses import dataclass

import numpy as np

from spiked.pose import Array, log_so3
from spiked.spline import Spline

HELD = 0.5
"""Views a knot, counted by the knot's part in their poses, from which on the knot is held by them."""
LOOSE = 3.0
"""How many times larger than usual second differences may be, where views tell, without being pulled at."""
TIGHT = 0.3
"""And elsewhere: errors of tracks last over many views, so these say less than their number makes believe."""
LEAST = 1e-6
"""Second differences (rad, and units of depth) that are not told from none."""


@dataclass(frozen=True)
class Inertia:
    """The prior of one spline with k knots; energies are in px^2, as sums of squared residuals of tracks."""

    differences: Array  # [k - 2, k]
    weights: Array  # [k - 2, 6], of (rotation, centre)

    @classmethod
    def of(cls, spline: Spline, blend: Array, noise_px: float) -> "Inertia":
        """For a spline seen by views with basis weights `blend` [views, k] and tracks with this noise."""
        held = blend.sum(0) >= HELD
        told = held[:-2] & held[1:-1] & held[2:]
        second = _second_differences(spline)
        seen = second[told] if told.sum() >= 3 else second
        size = np.repeat([np.sqrt((part**2).mean()) if len(part) else 0.0 for part in (seen[:, :3], seen[:, 3:])], 3)
        differences = np.diff(np.eye(blend.shape[1]), 2, axis=0)
        allowed = np.where(told, LOOSE, TIGHT)[:, None] * size
        return cls(differences, np.asarray(max(noise_px, 1e-3) ** 2 / (allowed**2 + LEAST**2)))

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
