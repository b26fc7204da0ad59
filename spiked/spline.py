"""A continuous camera path: a cumulative B-spline on SO(3) x R^3 over frames.

Rotation: R(t) = R_i Exp(lam_1 d_1) ... Exp(lam_n d_n) with d_j = Log(R_{i+j-1}^T R_{i+j}); centre: the ordinary
B-spline of the knots' centres. Degree 3 for smooth motion, degree 1 where motion is kinked.
(C. Sommer et al., "Efficient derivative computation for cumulative B-splines on Lie groups", CVPR 2020.)
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol, final

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from spiked.pose import Array, exp_so3, log_so3

__all__ = ["KnotTimeWarp", "Path", "Spline", "Waypoints", "interpolate_rotations"]

_BASIS = {
    1: np.array([[1.0, -1.0], [0.0, 1.0]]),
    3: np.array([[1, -3, 3, -1], [4, 0, -6, 3], [1, 3, 3, -3], [0, 0, 0, 1]]) / 6.0,
}
"""Weights of the degree + 1 knots as polynomials of u in [0, 1): row k holds the coefficients of 1, u, u^2, ..."""


DENSE_KNOTS = 1000
"""Knots up to which a spline is fitted by dense least squares, exact for any times; beyond, that takes gigabytes."""
SMOOTH = 1e-4
"""Weight of a second difference of knots beside a weight of 1 for each pose: it decides where no pose is near."""


@dataclass(frozen=True)
class KnotTimeWarp:
    """Time scale of the knots: ticks as a piecewise linear function of frames, one tick a frame outside.

    `frames` and `ticks` [n] both increase.
    """

    frames: Array
    ticks: Array

    def to_knot(self, times: ArrayLike) -> Array:
        """Ticks at times in frames."""
        return _straight(np.asarray(times, float), self.frames, self.ticks)

    def to_frame(self, ticks: ArrayLike) -> Array:
        """Times in frames at ticks."""
        return _straight(np.asarray(ticks, float), self.ticks, self.frames)


def _straight(x: Array, a: Array, b: Array) -> Array:
    return np.asarray(np.interp(x, a, b) + np.minimum(x - a[0], 0) + np.maximum(x - a[-1], 0))


class Path(Protocol):
    """Camera poses at any time from `begin` to `end`, in frames."""

    @property
    def begin(self) -> float:
        """First time (frames) at which it is defined."""

    @property
    def end(self) -> float:
        """Last time (frames) at which it is defined."""

    def poses(self, times: ArrayLike) -> tuple[Array, Array]:
        """Rotations [m, 3, 3] and centres [m, 3] at `times` [m] in frames."""


@final
@dataclass(frozen=True)
class Waypoints:
    """Poses at increasing `times` [n] (frames), and even turns and ways from each to the next.

    `smooth`: cubic curves go through them instead.
    """

    times: Array
    rotations: Array
    centres: Array
    smooth: bool = False

    @property
    def begin(self) -> float:
        """See `Path.begin`."""
        return float(self.times[0])

    @property
    def end(self) -> float:
        """See `Path.end`."""
        return float(self.times[-1])

    def poses(self, times: ArrayLike) -> tuple[Array, Array]:
        """See `Path.poses`; at rest beyond both ends."""
        at = np.clip(np.asarray(times, float), self.begin, self.end)
        rotations = interpolate_rotations(self.times, self.rotations, at)
        centres = _interpolate_linear(self.times, self.centres, at)
        if self.smooth and len(self.times) > 2:
            turned, moved = self._bent(at)
            rotations, centres = exp_so3(turned) @ rotations, centres + moved
        return rotations, centres

    def _bent(self, at: Array) -> tuple[Array, Array]:
        """What the smooth path turns and moves beyond the straight one, [m, 3] each: cubic Hermite segments, their
        speeds from the pose before to the one after. A space that is much longer than its neighbours is straight.

        A pose has an influence over two spaces to each side. Turns from one pose to the next are taken to be small.
        """
        spaces, steps, speeds = self._steps
        row = np.searchsorted(self.times, at, side="right").clip(1, len(self.times) - 1) - 1
        u = (at - self.times[row])[:, None] / spaces[row]
        first, last = (speeds[row + end] * spaces[row] - steps[row] for end in (0, 1))
        bent = u * (1 - u) * ((1 - u) * first - u * last)
        return bent[:, :3], bent[:, 3:]

    @cached_property
    def _steps(self) -> tuple[Array, Array, Array]:
        """Spaces [n - 1, 1] from each pose to the next, turns with ways [n - 1, 6], and speeds [n, 6] at the poses."""
        turns = log_so3(self.rotations[1:] @ self.rotations[:-1].swapaxes(1, 2))
        steps = np.concatenate([turns, np.diff(self.centres, axis=0)], 1)
        spaces = np.diff(self.times)[:, None]
        inner = (steps[1:] + steps[:-1]) / (spaces[1:] + spaces[:-1])
        return spaces, steps, np.concatenate([steps[:1] / spaces[:1], inner, steps[-1:] / spaces[-1:]])

    def bend(self, times: ArrayLike, rotation: Array, centre: Array) -> "Waypoints":
        """The path with poses perturbed: R <- Exp(rotation) R, c <- c + centre; both [m, 3] at increasing `times` [m],
        interpolated between them, and constant beyond."""
        at, known = np.clip(self.times, *np.asarray(times, float)[[0, -1]]), np.asarray(times, float)
        turns, ways = (_interpolate_linear(known, part, at) for part in (rotation, centre))
        return replace(self, rotations=exp_so3(turns) @ self.rotations, centres=self.centres + ways)


@dataclass
class Spline:
    """Knots at `first + k * spacing` frames, or ticks of a `time_warp` where there is one.

    `rotations` [n, 3, 3] camera-to-world, `centres` [n, 3], changed in place by optimisers. Times are in frames; the
    pose of frame k is at k + 0.5.
    """

    first: float
    spacing: float
    rotations: Array
    centres: Array
    degree: int = 3
    time_warp: KnotTimeWarp | None = None

    @classmethod
    def fit(
        cls,
        times: ArrayLike,
        rotations: Array,
        centres: Array,
        spacing: float,
        degree: int = 3,
        span: tuple[float, float] | None = None,
        time_warp: KnotTimeWarp | None = None,
    ) -> "Spline":
        """A spline through poses at increasing `times` [m] (frames), knots every `spacing` frames, defined over `span`
        (default: the given times); where no pose is near it continues at constant velocity. Least squares."""
        t = np.asarray(times, float)
        low, high = (t[0], t[-1]) if span is None else (min(span[0], t[0]), max(span[1], t[-1]))
        s = t
        if time_warp is not None:
            low, high, s = float(time_warp.to_knot(low)), float(time_warp.to_knot(high)), time_warp.to_knot(t)
        pad = (degree - 1) / 2
        count = int(np.ceil(max(high - low, 1e-6) / spacing)) + degree + 1
        first = low - pad * spacing - 1e-6
        knots = first + spacing * np.arange(count)
        spline = cls(
            first, spacing, interpolate_rotations(s, rotations, knots), np.zeros((count, 3)), degree, time_warp
        )
        steps = _DenseSteps(spline, t) if count <= DENSE_KNOTS else _BandedSteps(spline, t)
        spline.centres = _interpolate_linear(s, centres, knots)
        spline.centres = spline.centres + steps.towards(centres - spline.poses(t)[1])
        for _ in range(3):
            error = log_so3(rotations @ spline.poses(t)[0].swapaxes(-1, -2))
            spline.rotations = exp_so3(steps.towards(error)) @ spline.rotations
        return spline

    @property
    def begin(self) -> float:
        """First time (frames) at which the spline is defined."""
        return self._frames(self._begin)

    @property
    def end(self) -> float:
        """Last time (frames) at which the spline is defined."""
        return self._frames(self._begin + self.spacing * (len(self.centres) - self.degree))

    @property
    def _begin(self) -> float:
        return self.first + self.spacing * (self.degree - 1) / 2

    def _frames(self, tick: float) -> float:
        return tick if self.time_warp is None else float(self.time_warp.to_frame(tick))

    def locate(self, times: ArrayLike) -> tuple[NDArray[np.int64], Array]:
        """First knot i [m] and weights [m, degree + 1] of the knots i.. at `times` (clamped to the defined range)."""
        ticks = np.asarray(times, float) if self.time_warp is None else self.time_warp.to_knot(times)
        s = (ticks - self._begin) / self.spacing
        last = len(self.centres) - self.degree - 1
        i = np.clip(np.floor(s).astype(np.int64), 0, last)
        u = np.clip(s - i, 0.0, 1.0)
        return i, (u[..., None] ** np.arange(self.degree + 1)) @ _BASIS[self.degree].T

    def basis_matrix(self, times: ArrayLike) -> Array:
        """Dense weights [m, knots]: the pose at a time is, to first order, this blend of the knots' perturbations."""
        i, weights = self.locate(times)
        dense = np.zeros((len(i), len(self.centres)))
        np.put_along_axis(dense, i[:, None] + np.arange(self.degree + 1), weights, 1)
        return dense

    def poses(self, times: ArrayLike) -> tuple[Array, Array]:
        """Rotations [m, 3, 3] and centres [m, 3] at `times` [m] in frames."""
        i, weights = self.locate(times)
        k = i[:, None] + np.arange(self.degree + 1)
        centres = np.einsum("mk,mkd->md", weights, self.centres[k])
        cumulative = np.cumsum(weights[:, ::-1], 1)[:, ::-1]
        knots = self.rotations[k]
        rotation = knots[:, 0]
        for j in range(1, self.degree + 1):
            delta = log_so3(knots[:, j - 1].swapaxes(-1, -2) @ knots[:, j])
            rotation = rotation @ exp_so3(cumulative[:, j, None] * delta)
        return rotation, centres

    def move(self, rotation: Array, centre: Array) -> "Spline":
        """The spline with knots perturbed: R <- Exp(rotation) R, c <- c + centre; both [knots, 3]."""
        return replace(self, rotations=exp_so3(rotation) @ self.rotations, centres=self.centres + centre)


class _DenseSteps:
    """Steps [knots, 3] of a spline's knots that come nearest to steps at times, by least squares."""

    def __init__(self, spline: Spline, times: Array) -> None:
        count = len(spline.rotations)
        self._lhs = np.vstack([spline.basis_matrix(times), SMOOTH * np.diff(np.eye(count), 2, axis=0)])
        self._none = np.zeros((count - 2, 3))

    def towards(self, steps: Array) -> Array:
        """For steps [m, 3] at the times."""
        return np.asarray(np.linalg.lstsq(self._lhs, np.vstack([steps, self._none]), rcond=None)[0])


class _BandedSteps:
    """The same by normal equations, which are banded: time and memory in proportion to the knots."""

    def __init__(self, spline: Spline, times: Array) -> None:
        self._first, self._weights = spline.locate(times)
        self._count, size = len(spline.rotations), spline.degree + 1
        bands = np.zeros((max(size, 3), self._count))  # row d is the d-th diagonal below the main one
        for a in range(size):
            for b in range(a, size):
                np.add.at(bands[b - a], self._first + a, self._weights[:, a] * self._weights[:, b])
        bend = SMOOTH * np.array([1.0, -2.0, 1.0])
        for a in range(3):
            for b in range(a, 3):
                bands[b - a, a : self._count - 2 + a] += bend[a] * bend[b]
        self._factor = scipy.linalg.cholesky_banded(bands, lower=True)

    def towards(self, steps: Array) -> Array:
        """For steps [m, 3] at the times."""
        right = np.zeros((self._count, 3))
        for a in range(self._weights.shape[1]):
            np.add.at(right, self._first + a, self._weights[:, a, None] * steps)
        return np.asarray(scipy.linalg.cho_solve_banded((self._factor, True), right))


def interpolate_rotations(times: Array, rotations: Array, at: Array) -> Array:
    """Geodesic interpolation of rotations [m, 3, 3], continued at constant velocity outside: [k, 3, 3]."""
    if len(times) == 1:
        return np.repeat(rotations, len(at), 0)
    i = np.clip(np.searchsorted(times, at) - 1, 0, len(times) - 2)
    u = (at - times[i]) / (times[i + 1] - times[i])
    return np.asarray(rotations[i] @ exp_so3(u[:, None] * log_so3(rotations[i].swapaxes(-1, -2) @ rotations[i + 1])))


def _interpolate_linear(times: Array, values: Array, at: Array) -> Array:
    if len(times) == 1:
        return np.repeat(values, len(at), 0)
    i = np.clip(np.searchsorted(times, at) - 1, 0, len(times) - 2)
    u = ((at - times[i]) / (times[i + 1] - times[i]))[:, None]
    return np.asarray((1 - u) * values[i] + u * values[i + 1])
