"""The spline that follows poses found one by one: as coarse as the motion allows, kinked where it is kinked.

A pose that tracks leave loosely known in some directions (translation against rotation, mostly) must not pull there, so
departures are weighed by what each view saw: the Hessian of its pose, which makes them departures in the image.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np

from spiked.pose import Array, log_so3
from spiked.spline import Spline

SPACINGS = (128, 64, 32, 16, 8)
"""Frames between the knots of cubic splines."""
KINKED_SPACINGS = (16, 8)
"""Frames between the knots of straight pieces: interpolated video has a kink every few frames."""
PHASES = 4
"""Places of the first kink that are tried for each of these."""
MOST_KNOTS = 128
"""Of a spline over many seconds, or over long gaps, which gets wider spacings: all is solved densely."""
FINE_PX = 0.03
"""A departure in the image that needs no finer spline."""
NO_WORSE = 1.5
"""A coarser spline may leave this many times the least departure a degree of freedom."""


@dataclass(frozen=True)
class _Candidate:
    spline: Spline
    rms_px: float
    score: float
    """Squared departure a degree of freedom that the spline took away; noise alone leaves the same for all."""


def coarsest(
    times: Array, rotations: Array, centres: Array, hessians: Array, observations: int, span: tuple[float, float]
) -> Spline:
    """The spline over `span` (frames) that follows poses [n, 3, 3], [n, 3] at `times` with the fewest knots.

    hessians [n, 6, 6]: of (rotation, centre), left perturbations, in 1/px^2 summed over in all `observations`.
    """
    found: list[_Candidate] = []
    kinked = [(s, 1, p * s / PHASES) for s, p in product(KINKED_SPACINGS, range(PHASES))]
    widest = max(SPACINGS[0], (span[1] - span[0]) / MOST_KNOTS)
    for spacing, degree, phase in [(widest, 3, 0.0), *((s, 3, 0.0) for s in SPACINGS[1:]), *kinked]:
        begin = (span[0] - phase, span[1])
        knots = np.ceil((span[1] - begin[0]) / spacing) + degree + 1
        left = len(times) - knots
        if found and left < len(times) / 4:
            continue
        spline = Spline.fit(times, rotations, centres, spacing, degree, span=begin)
        spline, square = _fit_weighted(spline, times, rotations, centres, hessians)
        one = _Candidate(
            spline, float(np.sqrt(square / max(observations, 1))), square / max(len(times) - len(spline.centres), 1)
        )
        found.append(one)
        if one.rms_px < FINE_PX:
            break
    least = min(one.score for one in found)
    good = [one for one in found if one.score <= NO_WORSE * least or one.rms_px < FINE_PX]
    return min(good, key=lambda one: len(one.spline.centres)).spline


def _fit_weighted(
    spline: Spline, times: Array, rotations: Array, centres: Array, hessians: Array
) -> tuple[Spline, float]:
    """Gauss-Newton in the knots; also the weighted square of what is left."""
    blend = spline.basis_matrix(times)
    knots = blend.shape[1]
    by_knot = np.einsum("va,vij,vb->aibj", blend, hessians, blend, optimize=True).reshape(knots * 6, knots * 6)
    diagonal = np.diag(by_knot).copy()
    by_knot[np.diag_indices(knots * 6)] += 1e-6 * diagonal + 1e-9 * diagonal.max()
    for _ in range(2):
        left = _departure(spline, times, rotations, centres)
        right = np.einsum("va,vij,vj->ai", blend, hessians, left, optimize=True)
        step = np.asarray(np.linalg.solve(by_knot, right.ravel())).reshape(knots, 6)
        spline = spline.move(step[:, :3], step[:, 3:])
    left = _departure(spline, times, rotations, centres)
    return spline, float(np.einsum("vi,vij,vj->", left, hessians, left))


def _departure(spline: Spline, times: Array, rotations: Array, centres: Array) -> Array:
    turned, moved = spline.poses(times)
    return np.concatenate([log_so3(rotations @ turned.swapaxes(1, 2)), centres - moved], 1)
