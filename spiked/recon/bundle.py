"""Bundle adjustment of sparse points and poses: robust Levenberg-Marquardt with the points eliminated (Schur).

(B. Triggs et al., "Bundle adjustment - a modern synthesis", 1999.) Dense linear algebra throughout: the reduced
system of a few hundred poses is small, and the long sides are one matrix product.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

import spiked.native._odometry as _odometry
from spiked.pose import Array, exp_so3
from spiked.recon.inertia import Inertia
from spiked.recon.robust import median
from spiked.sensor import Intrinsics
from spiked.spline import Spline

Index = NDArray[np.int64]

MOST_LOG_FOCAL = 0.2
"""Change of the focal length's logarithm in one step, at most."""


@dataclass
class Bundle:
    """Poses, points and what was seen of them. `optimise` changes poses and points in place."""

    rotations: Array  # [C, 3, 3] camera-to-world
    centres: Array  # [C, 3]
    points: Array  # [P, 3] world
    camera: Index  # [M] the pose of each observation
    point: Index  # [M] the point of each observation
    pixels: Array  # [M, 2] px
    intrinsics: Intrinsics
    focal_free: bool = False
    """Whether the focal length (one for both axes) is adjusted too: then `intrinsics` changes as well."""

    def residuals(self) -> Array:
        """Reprojection errors [M, 2] in px; a point at or behind its camera has infinite error."""
        out = np.empty((len(self.camera), 2))
        _odometry.residuals(*self._seen(), out)
        return out

    def cost(self, scale_px: float) -> float:
        """Mean over observations of the Cauchy loss log(1 + e^2 / s^2)."""
        return float(_odometry.cost(*self._seen(), scale_px))

    def _seen(self) -> tuple[object, ...]:
        """What the compiled functions begin with."""
        k = self.intrinsics
        arrays = (self.rotations, self.centres, self.points, self.camera, self.point, self.pixels)
        return (*(np.ascontiguousarray(one) for one in arrays), k.fx, k.fy, k.cx, k.cy)

    def optimise(
        self, iterations: int, scale_px: float = 0.5, fixed: NDArray[np.bool_] | None = None, tolerance: float = 1e-4
    ) -> float:
        """Minimise the robust cost over all poses but the `fixed` ones ([C] bool; default: the first) and all points.

        The scale of the scene is left to the damping. Returns the final cost (see `cost`).
        """
        free = np.ones(len(self.centres), bool)
        if fixed is None:
            free[0] = False
        else:
            free &= ~fixed
        parts, room = _Parts.of_poses(free), None
        damping, current = 1e-3, self.cost(scale_px)
        for _ in range(iterations):
            while damping < 1e6:
                room = self._linearise(scale_px, parts, damping, room)
                trial = self._stepped(room.solve(damping), free)
                cost = trial.cost(scale_px)
                if cost < current:
                    break
                damping *= 8
            else:
                return current
            self.rotations, self.centres, self.points = trial.rotations, trial.centres, trial.points
            self.intrinsics = trial.intrinsics
            damping = max(damping / 5, 1e-8)
            gain, current = (current - cost) / current, cost
            if gain < tolerance:
                break
        return current

    def optimise_spline(
        self, spline: Spline, times: Array, iterations: int, scale_px: float = 0.5, tolerance: float = 1e-4
    ) -> tuple[Spline, float]:
        """As `optimise`, with the poses tied to a spline at `times` [C] (frames): returns spline and cost."""
        self.rotations, self.centres = spline.poses(times)
        inertia = Inertia.of(spline, spline.basis_matrix(times), self.noise_px())
        parts, room = _Parts.of_knots(spline, times), None
        share = 2 / (scale_px**2 * len(self.camera))  # of the energy: the cost is a mean in units of the scale
        damping, current = 1e-4, self.cost(scale_px) + share * inertia.energy(spline)
        for _ in range(iterations):
            prior = inertia.hessian(), inertia.gradient(spline)
            while damping < 1e6:
                room = self._linearise(scale_px, parts, damping, room)
                step = room.solve(damping, prior)
                moved = spline.move(step.poses[:, :3], step.poses[:, 3:])
                trial = self._moved(*moved.poses(times), step)
                cost = trial.cost(scale_px) + share * inertia.energy(moved)
                if cost < current:
                    break
                damping *= 8
            else:
                return spline, current
            spline, self.rotations, self.centres, self.points = moved, trial.rotations, trial.centres, trial.points
            self.intrinsics = trial.intrinsics
            damping = max(damping / 5, 1e-9)
            gain, current = (current - cost) / current, cost
            if gain < tolerance:
                break
        return spline, current

    def noise_px(self) -> float:
        """Standard deviation of a track's place in one view and one direction, from the median residual."""
        return median(np.linalg.norm(self.residuals(), axis=1)) / 1.1774

    def pose_hessians(self, scale_px: float) -> Array:
        """How firmly each pose is held by the points where they are: [C, 6, 6] of (rotation, centre), in 1/px^2."""
        return self._linearise(scale_px, _Parts.of_poses(np.zeros(len(self.centres), bool))).pose_hessian

    def focal_sigma(self, scale_px: float) -> float:
        """Relative standard deviation of the focal length with everything else free, if tracks were independent."""
        parts = _Parts.of_poses(np.ones(len(self.centres), bool))
        information = replace(self, focal_free=True)._linearise(scale_px, parts).focal_information()
        return float(self.noise_px() / np.sqrt(information)) if information > 0 else np.inf

    def spline_information(self, spline: Spline, times: Array, scale_px: float) -> Array:
        """What is known of the knots with all points free: [6 knots, 6 knots] of (rotation, centre), in 1/px^2."""
        inertia = Inertia.of(spline, spline.basis_matrix(times), self.noise_px())
        square = replace(self, focal_free=False)._linearise(scale_px, _Parts.of_knots(spline, times)).reduced()
        return square + inertia.hessian().reshape(square.shape)

    def _stepped(self, step: "_Step", free: NDArray[np.bool_]) -> "Bundle":
        rotations, centres = self.rotations.copy(), self.centres.copy()
        rotations[free] = exp_so3(step.poses[:, :3]) @ rotations[free]
        centres[free] += step.poses[:, 3:]
        return self._moved(rotations, centres, step)

    def _moved(self, rotations: Array, centres: Array, step: "_Step") -> "Bundle":
        """With these poses, and points and focal length as the step says."""
        points, intrinsics = self.points + step.points, _scaled(self.intrinsics, step.log_focal)
        return replace(self, rotations=rotations, centres=centres, points=points, intrinsics=intrinsics)

    def _linearise(
        self, scale_px: float, parts: "_Parts", damping: float = 0.0, room: "_System | None" = None
    ) -> "_System":
        """The normal equations; written over earlier ones of the same size, if given."""
        size = 6 * parts.count + self.focal_free
        cameras, points = len(self.centres), len(self.points)
        system = room or _System(
            np.empty((size, size)),
            np.empty(size),
            np.empty((3 * points, size)),
            np.empty((points, 3)),
            np.empty((points, 3, 3)),
            np.empty((cameras, 6, 6)),
            self.focal_free,
        )
        _odometry.linearise(
            *self._seen(),
            scale_px,
            damping,
            parts.slots,
            parts.shares,
            self.focal_free,
            system.hessian,
            system.gradient,
            system.eliminated,
            system.pull,
            system.roots,
            system.pose_hessian,
        )
        return system


def _scaled(intrinsics: Intrinsics, log_focal: float) -> Intrinsics:
    if log_focal == 0:
        return intrinsics
    factor = float(np.exp(np.clip(log_focal, -MOST_LOG_FOCAL, MOST_LOG_FOCAL)))
    return replace(intrinsics, fx=intrinsics.fx * factor, fy=intrinsics.fy * factor)


@dataclass(frozen=True)
class _Parts:
    """What poses are made of: themselves, or knots of a spline, `count` of six numbers each."""

    slots: Index  # [C, K] the parts of each pose; -1 where it is fixed
    shares: Array  # [C, K] how much each of them moves it
    count: int

    @classmethod
    def of_poses(cls, free: NDArray[np.bool_]) -> "_Parts":
        slots = np.where(free, np.cumsum(free) - 1, -1).astype(np.int64)[:, None]
        return cls(slots, free.astype(float)[:, None], int(free.sum()))

    @classmethod
    def of_knots(cls, spline: Spline, times: Array) -> "_Parts":
        first, shares = spline.locate(times)
        slots = first[:, None] + np.arange(spline.degree + 1)
        return cls(slots, np.ascontiguousarray(shares), len(spline.centres))


@dataclass(frozen=True)
class _Step:
    poses: Array  # [parts, 6]
    points: Array  # [P, 3]
    log_focal: float = 0.0


@dataclass(frozen=True)
class _System:
    """Normal equations of D unknowns, six for each part and perhaps one for the logarithm of the focal length, with the
    points' 3x3 blocks V taken out: R = chol(V)^-1."""

    hessian: Array  # [D, D] before the points are taken out, not damped
    gradient: Array  # [D]
    eliminated: Array  # [3 P, D]: R of each point times its cross terms
    pull: Array  # [P, 3]: R times the points' gradients
    roots: Array  # [P, 3, 3]: R
    pose_hessian: Array  # [C, 6, 6]
    focal_free: bool

    def reduced(self) -> Array:
        """The Hessian with the points taken out."""
        return np.asarray(self.hessian - self.eliminated.T @ self.eliminated)

    def focal_information(self) -> float:
        """What is known of the focal length's logarithm when all else is free, in 1/px^2."""
        assert self.focal_free
        square = self.reduced()
        poses, side = square[:-1, :-1], square[:-1, -1]
        poses[np.diag_indices(len(poses))] += 1e-9 * np.abs(np.diag(poses)).max()
        return float(square[-1, -1] - side @ np.linalg.solve(poses, side))

    def solve(self, damping: float, prior: tuple[Array, Array] | None = None) -> _Step:
        """Steps of the parts, of the points and of the focal length if it is free.

        `prior` is added to the Hessian [parts, 6, parts, 6] and gradient [parts, 6] of the parts.
        """
        square = self.reduced()
        right = self.eliminated.T @ self.pull.ravel() - self.gradient
        parts = len(square) - self.focal_free
        own = np.diag(self.hessian).copy()
        if prior is not None:
            held = prior[0].reshape(parts, parts)
            square[:parts, :parts] += held
            right[:parts] -= prior[1].ravel()
            own[:parts] += np.diag(held)
        square[np.diag_indices(len(square))] += damping * own + 1e-9
        solved, log_focal = np.asarray(right, float), 0.0
        if self.focal_free:
            side = square[:-1, -1]
            both = np.linalg.solve(square[:-1, :-1], np.stack([right[:-1], side], 1))
            left = square[-1, -1] - side @ both[:, 1]
            log_focal = float((right[-1] - side @ both[:, 0]) / max(left, 1e-9))
            log_focal = float(np.clip(log_focal, -MOST_LOG_FOCAL, MOST_LOG_FOCAL))
            solved = np.append(both[:, 0] - log_focal * both[:, 1], log_focal)
        elif parts:
            solved = np.asarray(np.linalg.solve(square, right))
        back = -self.pull - (self.eliminated @ solved).reshape(-1, 3)
        return _Step(solved[:parts].reshape(-1, 6), np.einsum("Pji,Pj->Pi", self.roots, back), log_focal)
