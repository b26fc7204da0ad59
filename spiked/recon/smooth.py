"""The spline that follows poses found one by one: as coarse as the motion allows, kinked where it is kinked.

A pose that tracks leave loosely known in some directions (translation against rotation, mostly) must not pull there, so
departures are weighed by what each view saw: the Hessian of its pose, which makes them departures in the image.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np

from spiked.pose import Array, log_so3
from spiked.recon.inertia import Inertia
from spiked.spline import Clock, Spline

SPACINGS = (128, 64, 32, 16, 8)
"""Frames between the knots of cubic splines."""
KINKED_SPACINGS = (16, 8)
"""Frames between the knots of straight pieces: interpolated video has a kink every few frames."""
PHASES = 4
"""Places of the first kink that are tried for each of these."""
MOST_KNOTS = 128
"""Of a spline over many seconds, or over long gaps, which gets wider spacings: all is solved densely."""
STILL_TICKS = 8.0
GAP_TICKS = 128.0
"""Frames at most that pass, on the clock of the knots, from view to view while a camera stands still or else."""
BURST = 4.0
"""Times as fast as in the views around it is a burst, for which the clock of the knots runs faster..."""
BURST_PX = 10.0
"""... where the image moves so far between two views."""
AROUND = 6
"""Views on either side that say what is usual."""
RARELY = 0.5
"""Above this share of the frames the clock is that of the frames."""
NOISE_PX = 0.1
"""Of the tracks behind the poses, in rough."""
FINE_PX = 0.03
"""A departure in the image that needs no finer spline."""
WORST_PX = 0.12
"""And of a single view."""
NO_WORSE = 1.5
"""A coarser spline may leave this many times the least departure a degree of freedom."""


@dataclass(frozen=True)
class _Candidate:
    spline: Spline
    rms_px: float
    score: float
    """Squared departure a degree of freedom that the spline took away; noise alone leaves the same for all."""
    worst_px: float
    """Departure of the view that it follows worst."""

    @property
    def fine(self) -> bool:
        """Whether it follows all views well enough: a moment at which the camera starts off is not lost in a mean."""
        return self.rms_px < FINE_PX and self.worst_px < WORST_PX


def coarsest(
    times: Array,
    rotations: Array,
    centres: Array,
    hessians: Array,
    observations: int,
    span: tuple[float, float],
    clock: Clock | None = None,
) -> Spline:
    """The spline over `span` (frames) that follows poses [n, 3, 3], [n, 3] at `times` with the fewest knots.

    hessians [n, 6, 6]: of (rotation, centre), left perturbations, in 1/px^2 summed over in all `observations`.
    clock: what the distance of knots is counted in, frames if None.
    """
    found: list[_Candidate] = []
    kinked = [(s, 1, p * s / PHASES) for s, p in product(KINKED_SPACINGS, range(PHASES))]
    low, high = span if clock is None else (float(tick) for tick in clock.ticked(span))
    widest = max(SPACINGS[0], (high - low) / MOST_KNOTS)
    for spacing, degree, phase in [(widest, 3, 0.0), *((s, 3, 0.0) for s in SPACINGS[1:]), *kinked]:
        begin = (span[0] - phase, span[1])
        knots = np.ceil((high - low + phase) / spacing) + degree + 1
        left = len(times) - knots
        if found and left < len(times) / 4:
            continue
        spline = Spline.fit(times, rotations, centres, spacing, degree, begin, clock)
        spline, squares = _fit_weighted(spline, times, rotations, centres, hessians)
        square, a_view = float(squares.sum()), max(observations / len(times), 1)
        one = _Candidate(
            spline,
            float(np.sqrt(square / max(observations, 1))),
            square / max(len(times) - len(spline.centres), 1),
            float(np.sqrt(squares.max() / a_view)),
        )
        found.append(one)
        if one.fine:
            break
    least = min(one.score for one in found)
    good = [one for one in found if one.score <= NO_WORSE * least or one.fine]
    return min(good, key=lambda one: len(one.spline.centres)).spline


@dataclass(frozen=True)
class Bursts:
    """Spans [n] of frames in which a camera moves `factors` [n] times as fast as around them."""

    begins: Array
    ends: Array
    factors: Array

    def at(self, times: Array) -> Array:
        """The factor at each time, 1 outside."""
        inside = (times[:, None] > self.begins) & (times[:, None] < self.ends)
        return np.asarray(np.where(inside, self.factors, 1.0).max(1, initial=1.0))


def bursts(times: Array, motion_px: Array) -> Bursts:
    """Where the image moves `motion_px` [n - 1] between views at `times` [n] so fast that no spline of even knots
    follows, and no camera that goes on as it went."""
    steps = np.diff(times)
    speed = motion_px / np.maximum(steps, 1e-9)
    factor = np.ones(len(steps))
    for k in np.flatnonzero(motion_px > BURST_PX):
        around = np.concatenate([speed[max(0, k - AROUND) : k], speed[k + 1 : k + 1 + AROUND]])
        if len(around):
            factor[k] = speed[k] / max(float(np.median(around)), 1e-3)
    quick = factor > BURST
    return Bursts(times[:-1][quick], times[1:][quick], factor[quick])


def clock_of(times: Array, still: Array, fast: Bursts | None = None) -> Clock | None:
    """The clock of a path with views at `times` [n], in which the camera stood `still` [n] since the view before: that
    time, and long gaps, needs no more knots than one ordinary view, and a burst of speed more. None where there is
    little of either."""
    steps = np.diff(times)
    quick = np.ones(len(steps)) if fast is None else fast.at(0.5 * (times[1:] + times[:-1]))
    short = np.minimum(steps * quick, np.where(still[1:] & (quick == 1), STILL_TICKS, GAP_TICKS))
    if len(steps) == 0 or (short.sum() > RARELY * steps.sum() and quick.max() == 1):
        return None
    return Clock(times, times[0] + np.concatenate([[0.0], np.cumsum(short)]))


def _fit_weighted(
    spline: Spline, times: Array, rotations: Array, centres: Array, hessians: Array
) -> tuple[Spline, Array]:
    """Gauss-Newton in the knots; also the weighted square of what is left of each view."""
    blend = spline.basis_matrix(times)
    knots = blend.shape[1]
    by_knot = np.einsum("va,vij,vb->aibj", blend, hessians, blend, optimize=True).reshape(knots * 6, knots * 6)
    diagonal = np.diag(by_knot).copy()
    inertia = Inertia.of(spline, blend, NOISE_PX)
    by_knot += inertia.hessian().reshape(by_knot.shape)
    by_knot[np.diag_indices(knots * 6)] += 1e-6 * diagonal + 1e-9 * diagonal.max()
    for _ in range(2):
        left = _departure(spline, times, rotations, centres)
        right = np.einsum("va,vij,vj->ai", blend, hessians, left, optimize=True)
        right -= inertia.gradient(spline)
        step = np.asarray(np.linalg.solve(by_knot, right.ravel())).reshape(knots, 6)
        spline = spline.move(step[:, :3], step[:, 3:])
    left = _departure(spline, times, rotations, centres)
    return spline, np.asarray(np.einsum("vi,vij,vj->v", left, hessians, left))


def _departure(spline: Spline, times: Array, rotations: Array, centres: Array) -> Array:
    turned, moved = spline.poses(times)
    return np.concatenate([log_so3(rotations @ turned.swapaxes(1, 2)), centres - moved], 1)
