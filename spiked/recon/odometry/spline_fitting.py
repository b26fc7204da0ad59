"""Fits the coarsest spline that follows free poses, piecewise linear where the motion has kinks.

Residuals are weighted by the Hessian of each pose, which turns them into image displacements: directions that the
tracks constrain weakly (mostly translation against rotation) get little weight.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np

from spiked.pose import Array, log_so3
from spiked.recon.odometry.smoothness_prior import SmoothnessPrior
from spiked.spline import KnotTimeWarp, Spline

SPACINGS = (128, 64, 32, 16, 8)
"""Frames between the knots of cubic splines."""
KINKED_SPACINGS = (16, 8)
"""Frames between the knots of piecewise linear splines: interpolated video has a kink every few frames."""
PHASES = 4
"""Offsets of the first kink tried for each of these."""
MOST_KNOTS = 128
"""Most knots of a spline (dense solver): longer paths get wider spacings."""
STILL_TICKS, GAP_TICKS = 8.0, 128.0
"""Longest step between views on the time scale of the knots, in frames, while the camera stands still and otherwise:
the finest and the coarsest of `SPACINGS` (decision 7)."""
BURST_SPEED_RATIO = 4.0
"""Speed over that of the surrounding views above which an interval is a burst, with closer knots (decision 10)."""
BURST_PX = 10.0
"""Image motion between two views that a burst needs."""
SPEED_NEIGHBOURS = 6
"""Views on either side that give the usual speed."""
MIN_WARPED_SHARE = 0.5
"""Warped over original duration above which knots stay evenly spaced in frames."""
NOISE_PX = 0.1
"""Approximate noise of the tracks behind the poses."""
FINE_PX = 0.03
"""RMS image residual that needs no finer spline."""
WORST_PX = 0.12
"""The same for the worst view."""
MAX_SCORE_RATIO = 1.5
"""Largest squared residual a degree of freedom of a coarser spline, over the smallest of all candidates."""
MIN_FREEDOM_SHARE = 0.25
"""Degrees of freedom that the residuals need, as a share of the views: finer splines follow the noise."""


@dataclass(frozen=True)
class _Candidate:
    spline: Spline
    rms_px: float
    score: float
    """Squared residual a degree of freedom; equal for all candidates if only noise is left."""
    worst_px: float
    """Image residual of the worst view."""

    @property
    def fine(self) -> bool:
        """Whether RMS and worst residual are small: a mean alone hides the start of a motion."""
        return self.rms_px < FINE_PX and self.worst_px < WORST_PX


def fit_coarsest_spline(
    times: Array,
    rotations: Array,
    centres: Array,
    hessians: Array,
    observations: int,
    span: tuple[float, float],
    time_warp: KnotTimeWarp | None = None,
) -> Spline:
    """The spline over `span` (frames) that follows poses [n, 3, 3], [n, 3] at `times` with the fewest knots.

    hessians [n, 6, 6]: of (rotation, centre), left perturbations, in 1/px^2, sums over `observations` in all.
    time_warp: time scale of the knot spacing; None: frames.
    """
    found: list[_Candidate] = []
    kinked = [(s, 1, p * s / PHASES) for s, p in product(KINKED_SPACINGS, range(PHASES))]
    low, high = span if time_warp is None else (float(tick) for tick in time_warp.to_knot(span))
    widest = max(SPACINGS[0], (high - low) / MOST_KNOTS)
    for spacing, degree, phase in [(widest, 3, 0.0), *((s, 3, 0.0) for s in SPACINGS[1:]), *kinked]:
        begin = (span[0] - phase, span[1])
        knots = np.ceil((high - low + phase) / spacing) + degree + 1
        degrees_of_freedom = len(times) - knots
        if found and degrees_of_freedom < MIN_FREEDOM_SHARE * len(times):
            continue
        spline = Spline.fit(times, rotations, centres, spacing, degree, begin, time_warp)
        spline, squares = fit_weighted(spline, times, rotations, centres, hessians)
        square, per_view = float(squares.sum()), max(observations / len(times), 1)
        one = _Candidate(
            spline,
            float(np.sqrt(square / max(observations, 1))),
            square / max(len(times) - len(spline.centres), 1),
            float(np.sqrt(squares.max() / per_view)),
        )
        found.append(one)
        if one.fine:
            break
    least = min(one.score for one in found)
    good = [one for one in found if one.score <= MAX_SCORE_RATIO * least or one.fine]
    return min(good, key=lambda one: len(one.spline.centres)).spline


@dataclass(frozen=True)
class MotionBursts:
    """Spans [n] of frames in which a camera moves `factors` [n] times as fast as around them."""

    begins: Array
    ends: Array
    factors: Array

    def at(self, times: Array) -> Array:
        """The factor at each time, 1 outside."""
        inside = (times[:, None] > self.begins) & (times[:, None] < self.ends)
        return np.asarray(np.where(inside, self.factors, 1.0).max(1, initial=1.0))


def motion_bursts(times: Array, motion_px: Array) -> MotionBursts:
    """Bursts, from the image motion `motion_px` [n - 1] between views at `times` [n]."""
    steps = np.diff(times)
    speed = motion_px / np.maximum(steps, 1e-9)
    factor = np.ones(len(steps))
    for k in np.flatnonzero(motion_px > BURST_PX):
        around = np.concatenate([speed[max(0, k - SPEED_NEIGHBOURS) : k], speed[k + 1 : k + 1 + SPEED_NEIGHBOURS]])
        if len(around):
            factor[k] = speed[k] / max(float(np.median(around)), 1e-3)
    burst = factor > BURST_SPEED_RATIO
    return MotionBursts(times[:-1][burst], times[1:][burst], factor[burst])


def knot_time_warp(times: Array, still: Array, fast: MotionBursts | None = None) -> KnotTimeWarp | None:
    """The time scale of the knots for views at `times` [n]; `still` [n]: the camera did not move since the view before.

    Standstills and long gaps get no more knots than one ordinary view, bursts of speed get more. None: frames suffice.
    """
    steps = np.diff(times)
    factors = np.ones(len(steps)) if fast is None else fast.at(0.5 * (times[1:] + times[:-1]))
    ticks = np.minimum(steps * factors, np.where(still[1:] & (factors == 1), STILL_TICKS, GAP_TICKS))
    if len(steps) == 0 or (ticks.sum() > MIN_WARPED_SHARE * steps.sum() and factors.max() == 1):
        return None
    return KnotTimeWarp(times, times[0] + np.concatenate([[0.0], np.cumsum(ticks)]))


def fit_weighted(
    spline: Spline, times: Array, rotations: Array, centres: Array, hessians: Array
) -> tuple[Spline, Array]:
    """Gauss-Newton in the knots; returns the spline and the weighted squared residual of each view."""
    blend = spline.basis_matrix(times)
    knots = blend.shape[1]
    by_knot = np.einsum("va,vij,vb->aibj", blend, hessians, blend, optimize=True).reshape(knots * 6, knots * 6)
    diagonal = np.diag(by_knot).copy()
    smoothness = SmoothnessPrior.of(spline, blend, NOISE_PX)
    by_knot += smoothness.hessian().reshape(by_knot.shape)
    by_knot[np.diag_indices(knots * 6)] += 1e-6 * diagonal + 1e-9 * diagonal.max()
    for _ in range(2):
        residuals = _residuals(spline, times, rotations, centres)
        right = np.einsum("va,vij,vj->ai", blend, hessians, residuals, optimize=True)
        right -= smoothness.gradient(spline)
        step = np.asarray(np.linalg.solve(by_knot, right.ravel())).reshape(knots, 6)
        spline = spline.move(step[:, :3], step[:, 3:])
    residuals = _residuals(spline, times, rotations, centres)
    return spline, np.asarray(np.einsum("vi,vij,vj->v", residuals, hessians, residuals))


def _residuals(spline: Spline, times: Array, rotations: Array, centres: Array) -> Array:
    on_spline, at = spline.poses(times)
    return np.concatenate([log_so3(rotations @ on_spline.swapaxes(1, 2)), centres - at], 1)
