"""Bundle adjustment of sparse points and poses: robust Levenberg-Marquardt with the points eliminated (Schur).

(B. Triggs et al., "Bundle adjustment - a modern synthesis", 1999.) Dense linear algebra throughout: the reduced
system of a few hundred poses is small, and the long sides are one matrix product.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from spiked.pose import Array, exp_so3, hat
from spiked.recon.inertia import Inertia
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
        local = self._local()
        k = self.intrinsics
        with np.errstate(divide="ignore", invalid="ignore"):
            uv = np.stack([k.fx * local[:, 0] / local[:, 2] + k.cx, k.fy * local[:, 1] / local[:, 2] + k.cy], 1)
        return np.where(local[:, 2:] > 1e-6, uv - self.pixels, np.inf)

    def _local(self) -> Array:
        ray = self.points[self.point] - self.centres[self.camera]
        return np.asarray(np.einsum("mji,mj->mi", self.rotations[self.camera], ray))

    def cost(self, scale_px: float) -> float:
        """Mean over observations of the Cauchy loss log(1 + e^2 / s^2)."""
        return float(np.mean(_cauchy(self.residuals(), scale_px)[0]))

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
        damping, current = 1e-3, self.cost(scale_px)
        for _ in range(iterations):
            system = self._linearise(scale_px, free)
            while damping < 1e6:
                trial = self._stepped(system.solve(damping), free)
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
        blend = spline.basis_matrix(times)
        inertia = Inertia.of(spline, blend, self.noise_px())
        share = 2 / (scale_px**2 * len(self.camera))  # of the energy: the cost is a mean in units of the scale
        everything = np.ones(len(self.centres), bool)
        damping, current = 1e-4, self.cost(scale_px) + share * inertia.energy(spline)
        for _ in range(iterations):
            system = self._linearise(scale_px, everything)
            while damping < 1e6:
                step = system.solve(damping, blend, (inertia.hessian(), inertia.gradient(spline)))
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
        return float(np.median(np.linalg.norm(self.residuals(), axis=1))) / 1.1774

    def pose_hessians(self, scale_px: float) -> Array:
        """How firmly each pose is held by the points where they are: [C, 6, 6] of (rotation, centre), in 1/px^2."""
        return self._linearise(scale_px, np.ones(len(self.centres), bool)).pose_hessian

    def focal_sigma(self, scale_px: float) -> float:
        """Relative standard deviation of the focal length with everything else free, if tracks were independent."""
        system = replace(self, focal_free=True)._linearise(scale_px, np.ones(len(self.centres), bool))
        information = system.focal_information()
        return float(self.noise_px() / np.sqrt(information)) if information > 0 else np.inf

    def spline_information(self, spline: Spline, times: Array, scale_px: float) -> Array:
        """What is known of the knots with all points free: [6 knots, 6 knots] of (rotation, centre), in 1/px^2."""
        blend = spline.basis_matrix(times)
        inertia = Inertia.of(spline, blend, self.noise_px())
        system = replace(self, focal_free=False)._linearise(scale_px, np.ones(len(self.centres), bool))
        square, _ = system.by_knots(blend)
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

    def _linearise(self, scale_px: float, free: NDArray[np.bool_]) -> "_System":
        local, k = self._local(), self.intrinsics
        z = np.maximum(local[:, 2], 1e-6)
        error = self.residuals()
        weight = _cauchy(error, scale_px)[1]
        error = np.where(np.isfinite(error), error, 0.0)
        zero = np.zeros_like(z)
        row_u = np.stack([k.fx / z, zero, -k.fx * local[:, 0] / z**2], 1)
        row_v = np.stack([zero, k.fy / z, -k.fy * local[:, 1] / z**2], 1)
        by_point = np.stack([row_u, row_v], 1) @ self.rotations[self.camera].swapaxes(1, 2)  # [M, 2, 3]
        ray = self.points[self.point] - self.centres[self.camera]
        by_pose = np.concatenate([by_point @ hat(ray), -by_point], 2)  # [M, 2, 6]
        by_focal = None
        if self.focal_free:
            by_focal = (error + self.pixels - [k.cx, k.cy]) * weight[:, None] ** 0.5
        return _System(
            by_pose * weight[:, None, None] ** 0.5,
            by_point * weight[:, None, None] ** 0.5,
            error * weight[:, None] ** 0.5,
            self.camera,
            self.point,
            free,
            len(self.points),
            by_focal,
        )


def _scaled(intrinsics: Intrinsics, log_focal: float) -> Intrinsics:
    if log_focal == 0:
        return intrinsics
    factor = float(np.exp(np.clip(log_focal, -MOST_LOG_FOCAL, MOST_LOG_FOCAL)))
    return replace(intrinsics, fx=intrinsics.fx * factor, fy=intrinsics.fy * factor)


def _cauchy(error: Array, scale_px: float) -> tuple[Array, Array]:
    """Loss and weight of each observation; infinite errors cost as much as a 1000-scale one and pull at nothing."""
    square = np.minimum((error / scale_px) ** 2, 1e6).sum(1)
    return np.log1p(square), np.where(np.isfinite(error).all(1), 1 / (1 + square), 0.0)


@dataclass(frozen=True)
class _Step:
    poses: Array  # [c, 6] of the free poses, or [knots, 6]
    points: Array  # [P, 3]
    log_focal: float = 0.0


class _System:
    """Normal equations with the points' 3x3 blocks kept apart."""

    def __init__(
        self,
        by_pose: Array,
        by_point: Array,
        error: Array,
        camera: Index,
        point: Index,
        free: NDArray[np.bool_],
        points: int,
        by_focal: Array | None = None,
    ) -> None:
        slot = np.cumsum(free) - 1
        seen = free[camera]
        cameras = int(free.sum())
        self.points_hessian = _sum_by(point, np.einsum("mki,mkj->mij", by_point, by_point), points)
        self.points_gradient = _sum_by(point, np.einsum("mki,mk->mi", by_point, error), points)
        a, b, e = by_pose[seen], by_point[seen], error[seen]
        c, p = slot[camera[seen]], point[seen]
        self.pose_hessian = _sum_by(c, np.einsum("mki,mkj->mij", a, a), cameras)
        self.pose_gradient = _sum_by(c, np.einsum("mki,mk->mi", a, e), cameras)
        self.cross = np.zeros((cameras, 6, points, 3))
        blocks = self.cross.transpose(0, 2, 1, 3)
        np.add.at(blocks, (c, p), np.einsum("mki,mkj->mij", a, b))
        self.focal: _Focal | None = None
        if by_focal is not None:
            self.focal = _Focal(
                float((by_focal**2).sum()),
                float((by_focal * error).sum()),
                _sum_by(c, np.einsum("mki,mk->mi", a, by_focal[seen]), cameras),
                _sum_by(point, np.einsum("mki,mk->mi", by_point, by_focal), points),
            )

    def reduced(self, damping: float = 0.0) -> tuple[Array, Array, Array]:
        """The Hessian of the free poses [6 c, 6 c] with the points eliminated, the inverse Hessians of the points
        [P, 3, 3], and the poses' cross terms times these [6 c, 3 P]."""
        cameras, _, points, _ = self.cross.shape
        v_inverse = np.linalg.inv(self.points_hessian * (1 + damping * np.eye(3)) + 1e-9 * np.eye(3))
        scaled = np.einsum("ciPj,Pjk->ciPk", self.cross, v_inverse, optimize=True).reshape(cameras * 6, points * 3)
        square = -scaled @ self.cross.reshape(cameras * 6, points * 3).T
        index = np.arange(cameras)
        own = self.pose_hessian * (1 + damping * np.eye(6)) + 1e-9 * np.eye(6)
        square.reshape(cameras, 6, cameras, 6)[index, :, index, :] += own
        return square, np.asarray(v_inverse), scaled

    def by_knots(self, blend: Array, damping: float = 0.0) -> tuple[Array, tuple[Array, Array]]:
        """As `reduced`, for poses that only move as the blend [c, knots] of knots: [6 knots, 6 knots]; and the rest."""
        square, v_inverse, scaled = self.reduced(damping)
        cameras, knots = blend.shape
        blocks = square.reshape(cameras, 6, cameras, 6)
        by_knot = np.tensordot(np.tensordot(blend, blocks, (0, 0)), blend, (2, 0))  # [k, 6, 6, k]
        return by_knot.transpose(0, 1, 3, 2).reshape(knots * 6, knots * 6), (v_inverse, scaled)

    def focal_information(self) -> float:
        """What is known of the focal length's logarithm when all else is free, in 1/px^2."""
        assert self.focal is not None
        square, v_inverse, scaled = self.reduced()
        square[np.diag_indices(len(square))] += 1e-9 * np.abs(np.diag(square)).max()
        by_points = self.focal.by_points
        side = self.focal.by_poses.ravel() - scaled @ by_points.ravel()
        left = self.focal.hessian - np.einsum("Pi,Pij,Pj->", by_points, v_inverse, by_points)
        return float(left - side @ np.linalg.solve(square, side))

    def solve(self, damping: float, blend: Array | None = None, prior: tuple[Array, Array] | None = None) -> _Step:
        """Steps of the free poses, of the points and of the focal length if it is free.

        With `blend` [c, knots] the poses move only as that blend of knots, and their steps are those of the knots;
        `prior` is added to their Hessian [knots, 6, knots, 6] and gradient [knots, 6].
        """
        cameras, _, points, _ = self.cross.shape
        if blend is None:
            square, v_inverse, scaled = self.reduced(damping)
        else:
            square, (v_inverse, scaled) = self.by_knots(blend, damping)
        downhill = (-self.pose_gradient.ravel() + scaled @ self.points_gradient.ravel()).reshape(cameras, 6)
        side = None
        if self.focal is not None:
            side = self.focal.by_poses - (scaled @ self.focal.by_points.ravel()).reshape(cameras, 6)
        if blend is not None:
            downhill = blend.T @ downhill
            side = None if side is None else blend.T @ side
            if prior is not None:
                square += prior[0].reshape(square.shape)
                downhill -= prior[1]
            square[np.diag_indices(len(square))] *= 1 + damping
            square[np.diag_indices(len(square))] += 1e-9
        right, log_focal = downhill.ravel(), 0.0
        if self.focal is not None and side is not None:
            both = np.linalg.solve(square, np.stack([right, side.ravel()], 1))
            by_points = np.einsum("Pij,Pj->Pi", v_inverse, self.focal.by_points)
            left = (
                self.focal.hessian * (1 + damping)
                - (by_points * self.focal.by_points).sum()
                - side.ravel() @ both[:, 1]
            )
            downhill_focal = -self.focal.gradient + (by_points * self.points_gradient).sum()
            log_focal = float((downhill_focal - side.ravel() @ both[:, 0]) / max(left, 1e-9))
            log_focal = float(np.clip(log_focal, -MOST_LOG_FOCAL, MOST_LOG_FOCAL))
            solved = both[:, 0] - log_focal * both[:, 1]
        else:
            solved = np.linalg.solve(square, right)
        steps = solved.reshape(-1, 6)
        poses = steps if blend is None else blend @ steps
        cross = self.cross.reshape(cameras * 6, points * 3)
        back = -self.points_gradient - (cross.T @ poses.ravel()).reshape(points, 3)
        if self.focal is not None:
            back -= log_focal * self.focal.by_points
        return _Step(steps, np.einsum("Pij,Pj->Pi", v_inverse, back), log_focal)


@dataclass(frozen=True)
class _Focal:
    """The focal length's row of the normal equations, for its logarithm."""

    hessian: float
    gradient: float
    by_poses: Array  # [c, 6]
    by_points: Array  # [P, 3]


def _sum_by(index: Index, values: Array, length: int) -> Array:
    out = np.zeros((length, *values.shape[1:]))
    np.add.at(out, index, values)
    return out
