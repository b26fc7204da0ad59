"""Normal equations of poses or knots with landmarks, and their reduction by the Schur complement.

(B. Triggs et al., "Bundle adjustment - a modern synthesis", 1999.) Dense linear algebra throughout: the reduced
system of a few hundred poses is small, and the long sides are one matrix product.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from spiked.distortion import Distortion, LensModel
from spiked.pose import Array
from spiked.sensor import Intrinsics
from spiked.spline import Spline

MOST_LOG_FOCAL = 0.2
"""Largest change of the focal length's logarithm in one step."""
MOST_RADIAL_STEP, MOST_RADIAL = 0.2, 2.0
"""Largest change of k1 and k2 in one step, and their largest values."""
RIDGE = 1e-9
"""Added to the diagonal of the reduced Hessian: unknowns that nothing observes stay where they are."""


def marginalise(hessian: Array, gradient: Array, eliminated: Array, whitened_gradient: Array) -> tuple[Array, Array]:
    """Hessian [D, D] and gradient [D] with landmarks marginalised (Schur complement).

    With the landmarks' Hessians V and R = chol(V)^-1: eliminated [3 P, D] is R times their cross terms,
    whitened_gradient [3 P] is R times their gradients.
    """
    return np.asarray(hessian - eliminated.T @ eliminated), np.asarray(gradient - eliminated.T @ whitened_gradient)


@dataclass(frozen=True)
class PoseBlocks:
    """Blocks of six unknowns that move C poses: the poses themselves, or the knots of a spline."""

    slots: NDArray[np.int64]
    """[C, K], the blocks that move each pose; -1 where it is fixed."""
    shares: Array
    """[C, K], how much each of them moves it."""
    count: int
    """Number of blocks."""

    @classmethod
    def of_poses(cls, free: NDArray[np.bool_]) -> "PoseBlocks":
        """One block for each pose that is `free` [C]."""
        slots = np.where(free, np.cumsum(free) - 1, -1).astype(np.int64)[:, None]
        return cls(slots, free.astype(float)[:, None], int(free.sum()))

    @classmethod
    def of_knots(cls, spline: Spline, times: Array) -> "PoseBlocks":
        """One block for each knot; poses at `times` [C]."""
        first, shares = spline.locate(times)
        slots = first[:, None] + np.arange(spline.degree + 1)
        return cls(slots, np.ascontiguousarray(shares), len(spline.centres))


@dataclass(frozen=True)
class FreeOptics:
    """Intrinsics that are adjusted: n unknowns, the logarithm of the focal length, then k1 and k2 of the lens."""

    focal: bool = False
    """One focal length for both axes."""
    radial: bool = False
    """Of OpenCV's lens where there is none yet."""

    @property
    def count(self) -> int:
        """n"""
        return self.focal + 2 * self.radial

    @property
    def limits(self) -> Array:
        """[n], the largest step of each."""
        return np.array([MOST_LOG_FOCAL] * self.focal + [MOST_RADIAL_STEP] * 2 * self.radial)

    def moved(self, intrinsics: Intrinsics, step: Array) -> Intrinsics:
        """Intrinsics after a step [n]."""
        if self.focal and step[0]:
            factor = float(np.exp(np.clip(step[0], -MOST_LOG_FOCAL, MOST_LOG_FOCAL)))
            intrinsics = replace(intrinsics, fx=intrinsics.fx * factor, fy=intrinsics.fy * factor)
        if self.radial:
            before = intrinsics.distortion
            lens = Distortion(LensModel.OPENCV, ()) if before is None else before
            k = np.array(lens.coefficients)
            k[:2] = np.clip(k[:2] + step[-2:], -MOST_RADIAL, MOST_RADIAL)
            intrinsics = replace(intrinsics, distortion=Distortion(lens.model, tuple(k.tolist())))
        return intrinsics


@dataclass(frozen=True)
class Step:
    """Solution of the normal equations."""

    blocks: Array
    """[blocks, 6] of (left rotation vector, centre)."""
    points: Array
    """[P, 3]"""
    optics: Array = field(default_factory=lambda: np.zeros(0))
    """[n] of the free optics."""


@dataclass(frozen=True)
class NormalEquations:
    """Normal equations of D unknowns, six a block and n of the free optics.

    The points' 3x3 blocks V are marginalised: R = chol(V)^-1.
    """

    hessian: Array
    """[D, D] before marginalisation, not damped."""
    gradient: Array
    """[D]"""
    eliminated: Array
    """[3 P, D]: R of each point times its cross terms."""
    whitened_gradient: Array
    """[P, 3]: R times the points' gradients."""
    roots: Array
    """[P, 3, 3]: R."""
    pose_hessian: Array
    """[C, 6, 6] of each pose with fixed points."""
    free: FreeOptics

    @classmethod
    def empty(cls, blocks: int, poses: int, points: int, free: FreeOptics) -> "NormalEquations":
        """Arrays to be filled."""
        size = 6 * blocks + free.count
        return cls(
            np.empty((size, size)),
            np.empty(size),
            np.empty((3 * points, size)),
            np.empty((points, 3)),
            np.empty((points, 3, 3)),
            np.empty((poses, 6, 6)),
            free,
        )

    def reduced(self) -> tuple[Array, Array]:
        """Hessian [D, D] and gradient [D] with the points marginalised."""
        return marginalise(self.hessian, self.gradient, self.eliminated, self.whitened_gradient.ravel())

    def of_optics(self) -> tuple[Array, Array]:
        """Hessian [n, n] and gradient [n] of the free optics with all else marginalised, in 1/px^2 times px^2."""
        size = len(self.hessian) - self.free.count
        hessian, gradient = self.reduced()
        poses, cross = hessian[:size, :size], hessian[:size, size:]
        poses[np.diag_indices(size)] += RIDGE * np.abs(np.diag(poses)).max()
        solved = np.linalg.solve(poses, np.column_stack([cross, gradient[:size]]))
        return hessian[size:, size:] - cross.T @ solved[:, :-1], gradient[size:] - cross.T @ solved[:, -1]

    def solve(self, damping: float, prior: tuple[Array, Array] | None = None) -> Step:
        """Steps of the blocks, the points and the free optics.

        `prior` is added to the Hessian [blocks, 6, blocks, 6] and gradient [blocks, 6] of the blocks.
        """
        hessian, gradient = self.reduced()
        right = -gradient
        size = len(hessian) - self.free.count
        diagonal = np.diag(self.hessian).copy()
        if prior is not None:
            prior_hessian = prior[0].reshape(size, size)
            hessian[:size, :size] += prior_hessian
            right[:size] -= prior[1].ravel()
            diagonal[:size] += np.diag(prior_hessian)
        hessian[np.diag_indices(len(hessian))] += damping * diagonal + RIDGE
        solution, optics = right, np.zeros(0)
        if self.free.count:
            cross = hessian[:size, size:]
            sides = np.column_stack([right[:size], cross])
            solutions = np.asarray(np.linalg.solve(hessian[:size, :size], sides), np.float64)
            blocks, optics = optics_step(solutions, cross, hessian[size:, size:], right[size:], self.free.limits)
            solution = np.append(blocks, optics)
        elif size:
            solution = np.asarray(np.linalg.solve(hessian, right))
        whitened = -self.whitened_gradient - (self.eliminated @ solution).reshape(-1, 3)
        return Step(solution[:size].reshape(-1, 6), np.einsum("Pji,Pj->Pi", self.roots, whitened), optics)


def optics_step(solutions: Array, cross: Array, hessian: Array, right: Array, limits: Array) -> tuple[Array, Array]:
    """Solution [D] of the blocks and the limited step [n] of the free optics, with their cross terms `cross` [D, n].

    solutions [D, 1 + n] solve the blocks' system for their right side and for `cross`; hessian [n, n] and right [n] are
    of the optics.
    """
    complement = hessian - cross.T @ solutions[:, 1:]
    complement[np.diag_indices(len(right))] = np.maximum(np.diag(complement), RIDGE)
    step = np.linalg.solve(complement, right - cross.T @ solutions[:, 0])
    step = np.clip(step, -limits, limits)
    return np.asarray(solutions[:, 0] - solutions[:, 1:] @ step), step
