"""Normal equations of poses or knots with landmarks, and their reduction by the Schur complement.

(B. Triggs et al., "Bundle adjustment - a modern synthesis", 1999.) Dense linear algebra throughout: the reduced
system of a few hundred poses is small, and the long sides are one matrix product.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spiked.pose import Array
from spiked.spline import Spline

MOST_LOG_FOCAL = 0.2
"""Largest change of the focal length's logarithm in one step."""
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
class Step:
    """Solution of the normal equations."""

    blocks: Array
    """[blocks, 6] of (left rotation vector, centre)."""
    points: Array
    """[P, 3]"""
    log_focal: float = 0.0


@dataclass(frozen=True)
class NormalEquations:
    """Normal equations of D unknowns, six a block and one for the log focal length if it is free.

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
    focal_free: bool

    @classmethod
    def empty(cls, blocks: int, poses: int, points: int, focal_free: bool) -> "NormalEquations":
        """Arrays to be filled."""
        size = 6 * blocks + focal_free
        return cls(
            np.empty((size, size)),
            np.empty(size),
            np.empty((3 * points, size)),
            np.empty((points, 3)),
            np.empty((points, 3, 3)),
            np.empty((poses, 6, 6)),
            focal_free,
        )

    def reduced(self) -> tuple[Array, Array]:
        """Hessian [D, D] and gradient [D] with the points marginalised."""
        return marginalise(self.hessian, self.gradient, self.eliminated, self.whitened_gradient.ravel())

    def focal_information(self) -> float:
        """Information of the log focal length with all else free, in 1/px^2."""
        assert self.focal_free
        hessian, _ = self.reduced()
        poses, cross = hessian[:-1, :-1], hessian[:-1, -1]
        poses[np.diag_indices(len(poses))] += RIDGE * np.abs(np.diag(poses)).max()
        return float(hessian[-1, -1] - cross @ np.linalg.solve(poses, cross))

    def solve(self, damping: float, prior: tuple[Array, Array] | None = None) -> Step:
        """Steps of the blocks, the points and, if free, the focal length.

        `prior` is added to the Hessian [blocks, 6, blocks, 6] and gradient [blocks, 6] of the blocks.
        """
        hessian, gradient = self.reduced()
        right = -gradient
        size = len(hessian) - self.focal_free
        diagonal = np.diag(self.hessian).copy()
        if prior is not None:
            prior_hessian = prior[0].reshape(size, size)
            hessian[:size, :size] += prior_hessian
            right[:size] -= prior[1].ravel()
            diagonal[:size] += np.diag(prior_hessian)
        hessian[np.diag_indices(len(hessian))] += damping * diagonal + RIDGE
        solution, log_focal = right, 0.0
        if self.focal_free:
            solution, log_focal = _solve_with_focal(hessian, right)
        elif size:
            solution = np.asarray(np.linalg.solve(hessian, right))
        whitened = -self.whitened_gradient - (self.eliminated @ solution).reshape(-1, 3)
        return Step(solution[:size].reshape(-1, 6), np.einsum("Pji,Pj->Pi", self.roots, whitened), log_focal)


def _solve_with_focal(hessian: Array, right: Array) -> tuple[Array, float]:
    """Solution [D] whose last unknown, the log focal length, is limited; and that unknown."""
    cross = hessian[:-1, -1]
    solutions = np.asarray(np.linalg.solve(hessian[:-1, :-1], np.stack([right[:-1], cross], 1)), np.float64)
    blocks, log_focal = focal_step(solutions, cross, hessian[-1, -1], right[-1])
    return np.append(blocks, log_focal), log_focal


def focal_step(solutions: Array, cross: Array, hessian: float, right: float) -> tuple[Array, float]:
    """Solution [D] of the blocks and the limited step of the log focal length, with its cross terms `cross` [D].

    solutions [D, 2] solve the blocks' system for their right side and for `cross`; hessian and right are of the focal
    length.
    """
    complement = float(hessian - cross @ solutions[:, 1])
    log_focal = (right - float(cross @ solutions[:, 0])) / max(complement, RIDGE)
    log_focal = float(np.clip(log_focal, -MOST_LOG_FOCAL, MOST_LOG_FOCAL))
    return np.asarray(solutions[:, 0] - log_focal * solutions[:, 1]), log_focal
