"""Bundle adjustment of sparse points and poses: robust Levenberg-Marquardt with the points eliminated (Schur).

(B. Triggs et al., "Bundle adjustment - a modern synthesis", 1999.) Dense linear algebra throughout: the reduced
system of a few hundred poses is small, and the long sides are one matrix product.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spiked.pose import Array, exp_so3, hat
from spiked.recon.inertia import Inertia
from spiked.sensor import Intrinsics
from spiked.spline import Spline

Index = NDArray[np.int64]


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
                trial = self._stepped(*system.solve(damping), free)
                cost = trial.cost(scale_px)
                if cost < current:
                    break
                damping *= 8
            else:
                return current
            self.rotations, self.centres, self.points = trial.rotations, trial.centres, trial.points
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
                step, points = system.solve(damping, blend, (inertia.hessian(), inertia.gradient(spline)))
                moved = spline.move(step[:, :3], step[:, 3:])
                trial = Bundle(
                    *moved.poses(times), self.points + points, self.camera, self.point, self.pixels, self.intrinsics
                )
                cost = trial.cost(scale_px) + share * inertia.energy(moved)
                if cost < current:
                    break
                damping *= 8
            else:
                return spline, current
            spline, self.rotations, self.centres, self.points = moved, trial.rotations, trial.centres, trial.points
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

    def _stepped(self, poses: Array, points: Array, free: NDArray[np.bool_]) -> "Bundle":
        rotations, centres = self.rotations.copy(), self.centres.copy()
        rotations[free] = exp_so3(poses[:, :3]) @ rotations[free]
        centres[free] += poses[:, 3:]
        moved = self.points + points
        return Bundle(rotations, centres, moved, self.camera, self.point, self.pixels, self.intrinsics)

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
        return _System(
            by_pose * weight[:, None, None] ** 0.5,
            by_point * weight[:, None, None] ** 0.5,
            error * weight[:, None] ** 0.5,
            self.camera,
            self.point,
            free,
            len(self.points),
        )


def _cauchy(error: Array, scale_px: float) -> tuple[Array, Array]:
    """Loss and weight of each observation; infinite errors cost as much as a 1000-scale one and pull at nothing."""
    square = np.minimum((error / scale_px) ** 2, 1e6).sum(1)
    return np.log1p(square), np.where(np.isfinite(error).all(1), 1 / (1 + square), 0.0)


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

    def solve(
        self, damping: float, blend: Array | None = None, prior: tuple[Array, Array] | None = None
    ) -> tuple[Array, Array]:
        """Steps of the free poses [c, 6] and of the points [P, 3].

        With `blend` [c, knots] the poses move only as that blend of knots, and their steps [knots, 6] are returned;
        `prior` is added to their Hessian [knots, 6, knots, 6] and gradient [knots, 6].
        """
        cameras, _, points, _ = self.cross.shape
        eye = np.eye(3)
        v = self.points_hessian * (1 + damping * eye) + 1e-9 * eye
        v_inverse = np.linalg.inv(v)
        scaled = np.einsum("ciPj,Pjk->ciPk", self.cross, v_inverse, optimize=True).reshape(cameras * 6, points * 3)
        cross = self.cross.reshape(cameras * 6, points * 3)
        reduced = -scaled @ cross.T
        blocks = reduced.reshape(cameras, 6, cameras, 6)
        index = np.arange(cameras)
        blocks[index, :, index, :] += self.pose_hessian * (1 + damping * np.eye(6)) + 1e-9 * np.eye(6)
        right = -self.pose_gradient.ravel() + scaled @ self.points_gradient.ravel()
        if blend is None:
            steps = np.linalg.solve(reduced, right).reshape(cameras, 6)
            poses = steps
        else:
            knots = blend.shape[1]
            by_knot = np.tensordot(np.tensordot(blend, blocks, (0, 0)), blend, (2, 0))  # [k, 6, 6, k]
            square = by_knot.transpose(0, 1, 3, 2).reshape(knots * 6, knots * 6)
            downhill = blend.T @ right.reshape(cameras, 6)
            if prior is not None:
                square += prior[0].reshape(knots * 6, knots * 6)
                downhill -= prior[1]
            square[np.diag_indices(knots * 6)] *= 1 + damping
            square[np.diag_indices(knots * 6)] += 1e-9
            steps = np.linalg.solve(square, downhill.ravel()).reshape(knots, 6)
            poses = blend @ steps
        back = -self.points_gradient - (cross.T @ poses.ravel()).reshape(points, 3)
        return steps, np.einsum("Pij,Pj->Pi", v_inverse, back)


def _sum_by(index: Index, values: Array, length: int) -> Array:
    out = np.zeros((length, *values.shape[1:]))
    np.add.at(out, index, values)
    return out
