"""Bundle adjustment of sparse points and poses: robust Levenberg-Marquardt with the points eliminated (Schur)."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

import spiked.native._bundle as _bundle
from spiked.pose import Array, exp_so3
from spiked.recon.odometry.normal_equations import FreeOptics, NormalEquations, PoseBlocks, Step
from spiked.recon.odometry.smoothness_prior import SmoothnessPrior
from spiked.recon.statistics import RAYLEIGH_MEDIAN, median
from spiked.sensor import Intrinsics
from spiked.spline import Spline

Index = NDArray[np.int64]

MOST_DAMPING = 1e6
"""The search ends if a step of this damping does not lower the cost."""
DAMPING_UP, DAMPING_DOWN = 8, 5
"""Factor of the damping after a rejected step, and divisor after an accepted one."""

Trial = TypeVar("Trial")


@dataclass(frozen=True)
class LevenbergMarquardt:
    """Levenberg-Marquardt loop: a rejected step raises the damping, an accepted one lowers it."""

    damping: float
    """Of the first step."""
    least_damping: float
    iterations: int
    """Accepted steps, at most."""
    tolerance: float
    """The search ends after a step of smaller relative gain."""

    def minimise(
        self, cost: float, attempt: Callable[[float], tuple[float, Trial]], accept: Callable[[Trial], None]
    ) -> float:
        """Minimise from `cost`: `attempt` computes a step for a damping, returns its cost and the argument of `accept`.

        Returns the final cost.
        """
        damping = self.damping
        for _ in range(self.iterations):
            while damping < MOST_DAMPING:
                tried, trial = attempt(damping)
                if tried < cost:
                    break
                damping *= DAMPING_UP
            else:
                return cost
            accept(trial)
            damping = max(damping / DAMPING_DOWN, self.least_damping)
            gain, cost = (cost - tried) / cost, tried
            if gain < self.tolerance:
                break
        return cost


@dataclass
class Bundle:
    """Poses, points and observations. `optimise` changes poses and points in place."""

    rotations: Array  # [C, 3, 3] camera-to-world
    centres: Array  # [C, 3]
    points: Array  # [P, 3] world
    camera: Index  # [M] the pose of each observation
    point: Index  # [M] the point of each observation
    pixels: Array  # [M, 2] px
    intrinsics: Intrinsics
    free: FreeOptics = field(default_factory=FreeOptics)
    """What is adjusted of `intrinsics`."""

    def residuals(self) -> Array:
        """Reprojection errors [M, 2] in px; a point at or behind its camera has infinite error."""
        out = np.empty((len(self.camera), 2))
        _bundle.residuals(*self._seen(), out, **self.intrinsics.lens())
        return out

    def cost(self, scale_px: float) -> float:
        """Mean over observations of the Cauchy loss log(1 + e^2 / s^2); infinite if a free lens folds the image."""
        if self.free.radial and self.intrinsics.folds:
            return np.inf
        return float(_bundle.cost(*self._seen(), scale_px, **self.intrinsics.lens()))

    def _seen(self) -> tuple[object, ...]:
        """First arguments of the compiled functions."""
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
        blocks, workspace = PoseBlocks.of_poses(free), None

        def attempt(damping: float) -> tuple[float, Bundle]:
            nonlocal workspace
            workspace = self.linearise(scale_px, blocks, damping, workspace)
            trial = self.stepped(workspace.solve(damping), free)
            return trial.cost(scale_px), trial

        search = LevenbergMarquardt(damping=1e-3, least_damping=1e-8, iterations=iterations, tolerance=tolerance)
        return search.minimise(self.cost(scale_px), attempt, self.take)

    def optimise_spline(
        self, spline: Spline, times: Array, iterations: int, scale_px: float = 0.5, tolerance: float = 1e-4
    ) -> tuple[Spline, float]:
        """As `optimise`, with the poses tied to a spline at `times` [C] (frames): returns spline and cost."""
        self.rotations, self.centres = spline.poses(times)
        smoothness = SmoothnessPrior.of(spline, spline.basis_matrix(times), self.noise_px())
        blocks, workspace = PoseBlocks.of_knots(spline, times), None
        share = 2 / (scale_px**2 * len(self.camera))  # of the energy: the cost is a mean in units of the scale
        prior = smoothness.hessian(), smoothness.gradient(spline)

        def attempt(damping: float) -> tuple[float, tuple[Spline, Bundle]]:
            nonlocal workspace
            workspace = self.linearise(scale_px, blocks, damping, workspace)
            step = workspace.solve(damping, prior)
            moved = spline.move(step.blocks[:, :3], step.blocks[:, 3:])
            trial = self._moved(*moved.poses(times), step)
            return trial.cost(scale_px) + share * smoothness.energy(moved), (moved, trial)

        def accept(found: tuple[Spline, Bundle]) -> None:
            nonlocal spline, prior
            spline = found[0]
            self.take(found[1])
            prior = smoothness.hessian(), smoothness.gradient(spline)

        search = LevenbergMarquardt(damping=1e-4, least_damping=1e-9, iterations=iterations, tolerance=tolerance)
        cost = search.minimise(self.cost(scale_px) + share * smoothness.energy(spline), attempt, accept)
        return spline, cost

    def take(self, other: "Bundle") -> None:
        """Take over the poses, points and intrinsics of another bundle."""
        self.rotations, self.centres, self.points = other.rotations, other.centres, other.points
        self.intrinsics = other.intrinsics

    def noise_px(self) -> float:
        """Standard deviation of a track's place in one view and one direction, from the median residual."""
        return median(np.linalg.norm(self.residuals(), axis=1)) / RAYLEIGH_MEDIAN

    def pose_hessians(self, scale_px: float) -> Array:
        """Information of each pose with fixed points: [C, 6, 6] of (rotation, centre), in 1/px^2."""
        return self.linearise(scale_px, PoseBlocks.of_poses(np.zeros(len(self.centres), bool))).pose_hessian

    def optics_covariance(self, scale_px: float) -> Array:
        """Covariance [n, n] of the free optics, all else free, for independent track errors."""
        blocks = PoseBlocks.of_poses(np.ones(len(self.centres), bool))
        information, _ = self.linearise(scale_px, blocks).of_optics()
        if np.linalg.eigvalsh(information).min(initial=np.inf) <= 0:
            return np.full(information.shape, np.inf)
        return np.asarray(self.noise_px() ** 2 * np.linalg.inv(information))

    def spline_information(self, spline: Spline, times: Array, scale_px: float) -> Array:
        """Information of the knots, points marginalised: [6 knots, 6 knots] of (rotation, centre), in 1/px^2."""
        smoothness = SmoothnessPrior.of(spline, spline.basis_matrix(times), self.noise_px())
        hessian, _ = replace(self, free=FreeOptics()).linearise(scale_px, PoseBlocks.of_knots(spline, times)).reduced()
        return hessian + smoothness.hessian().reshape(hessian.shape)

    def stepped(self, step: Step, free: NDArray[np.bool_]) -> "Bundle":
        rotations, centres = self.rotations.copy(), self.centres.copy()
        rotations[free] = exp_so3(step.blocks[:, :3]) @ rotations[free]
        centres[free] += step.blocks[:, 3:]
        return self._moved(rotations, centres, step)

    def _moved(self, rotations: Array, centres: Array, step: Step) -> "Bundle":
        """With these poses, and points and free optics moved by the step."""
        points, intrinsics = self.points + step.points, self.free.moved(self.intrinsics, step.optics)
        return replace(self, rotations=rotations, centres=centres, points=points, intrinsics=intrinsics)

    def linearise(
        self, scale_px: float, blocks: PoseBlocks, damping: float = 0.0, workspace: NormalEquations | None = None
    ) -> NormalEquations:
        """The normal equations, with damped points; written over earlier ones of the same size, if given."""
        system = workspace or NormalEquations.empty(blocks.count, len(self.centres), len(self.points), self.free)
        _bundle.linearise(
            *self._seen(),
            scale_px,
            damping,
            blocks.slots,
            blocks.shares,
            self.free.focal,
            self.free.radial,
            system.hessian,
            system.gradient,
            system.eliminated,
            system.whitened_gradient,
            system.roots,
            system.pose_hessian,
            **self.intrinsics.lens(),
        )
        return system
