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


def marginalise(hessian: Array, gradient: Array, eliminated: Array, pull: Array) -> tuple[Array, Array]:
    """Hessian [D, D] and gradient [D] with landmarks marginalised (Schur complement).

    With the landmarks' Hessians V and R = chol(V)^-1: eliminated [3 P, D] is R times their cross terms, pull [3 P] is R
    times their gradients.
    """
    return np.asarray(hessian - eliminated.T @ eliminated), np.asarray(gradient - eliminated.T @ pull)


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
    pull: Array
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
        return marginalise(self.hessian, self.gradient, self.eliminated, self.pull.ravel())

    def focal_information(self) -> float:
        """Information of the log focal length with all else free, in 1/px^2."""
        assert self.focal_free
        square, _ = self.reduced()
        poses, side = square[:-1, :-1], square[:-1, -1]
        poses[np.diag_indices(len(poses))] += RIDGE * np.abs(np.diag(poses)).max()
        return float(square[-1, -1] - side @ np.linalg.solve(poses, side))

    def solve(self, damping: float, prior: tuple[Array, Array] | None = None) -> Step:
        """Steps of the blocks, the points and, if free, the focal length.

        `prior` is added to the Hessian [blocks, 6, blocks, 6] and gradient [blocks, 6] of the blocks.
        """
        square, gradient = self.reduced()
        right = -gradient
        size = len(square) - self.focal_free
        own = np.diag(self.hessian).copy()
        if prior is not None:
            held = prior[0].reshape(size, size)
            square[:size, :size] += held
            right[:size] -= prior[1].ravel()
            own[:size] += np.diag(held)
        square[np.diag_indices(len(square))] += damping * own + RIDGE
        solved, log_focal = right, 0.0
        if self.focal_free:
            solved, log_focal = _solve_with_focal(square, right)
        elif size:
            solved = np.asarray(np.linalg.solve(square, right))
        back = -self.pull - (self.eliminated @ solved).reshape(-1, 3)
        return Step(solved[:size].reshape(-1, 6), np.einsum("Pji,Pj->Pi", self.roots, back), log_focal)


def _solve_with_focal(square: Array, right: Array) -> tuple[Array, float]:
    """Solution [D] whose last unknown, the log focal length, is limited; and that unknown."""
    side = square[:-1, -1]
    both = np.asarray(np.linalg.solve(square[:-1, :-1], np.stack([right[:-1], side], 1)), np.float64)
    blocks, log_focal = focal_step(both, side, square[-1, -1], right[-1])
    return np.append(blocks, log_focal), log_focal


def focal_step(both: Array, side: Array, hessian: float, right: float) -> tuple[Array, float]:
    """Solution [D] of the blocks and the limited step of the log focal length, with its cross terms `side` [D].

    both [D, 2] solve the blocks' system for their right side and for `side`; hessian and right are of the focal length.
    """
    left = float(hessian - side @ both[:, 1])
    log_focal = (right - float(side @ both[:, 0])) / max(left, RIDGE)
    log_focal = float(np.clip(log_focal, -MOST_LOG_FOCAL, MOST_LOG_FOCAL))
    return np.asarray(both[:, 0] - log_focal * both[:, 1]), log_focal
