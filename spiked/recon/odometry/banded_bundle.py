"""Bundle adjustment of many poses: the reduced system of poses is banded, and its cost grows linearly with the path.

Points are marginalised in groups that few poses see. The poses are ordered by reverse Cuthill-McKee, which keeps the
band narrow where the path closes loops (E. Cuthill, J. McKee, "Reducing the bandwidth of sparse symmetric matrices",
1969).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import reverse_cuthill_mckee

from spiked.pose import Array
from spiked.recon.odometry.bundle_adjustment import Bundle, LevenbergMarquardt
from spiked.recon.odometry.normal_equations import RIDGE, FreeOptics, NormalEquations, PoseBlocks, Step, optics_step

Index = NDArray[np.int64]

GROUP_POINTS = 128
"""Most points marginalised at once: the memory of a group grows with these and with the poses that see any of them."""


@dataclass(frozen=True)
class _Group:
    """Points that are marginalised together, and the poses that see them."""

    points: Index
    """[p] in the bundle."""
    cameras: Index
    """[c] in the bundle."""
    observations: Index
    """[m] in the bundle."""
    camera: Index
    """[m], in `cameras`."""
    point: Index
    """[m], in `points`."""
    blocks: PoseBlocks
    unknowns: Index
    """[6 f] places of the free poses' unknowns in the banded system."""


@dataclass(frozen=True)
class BandedStructure:
    """Which poses and points of a bundle are linked; it does not change during an adjustment."""

    groups: list[_Group]
    order: Index
    """[F] place of each free pose in the banded system."""
    bandwidth: int
    """Off-diagonals of the banded system above its diagonal."""

    @classmethod
    def of(cls, bundle: Bundle, free: NDArray[np.bool_]) -> "BandedStructure":
        """For the poses that are `free` [C]."""
        rank = np.where(free, np.cumsum(free) - 1, -1)
        seen = csr_matrix(
            (np.ones(len(bundle.camera), np.int8), (bundle.point, bundle.camera)),
            (len(bundle.points), len(bundle.centres)),
        )[:, np.flatnonzero(free)]
        links = (seen.T.astype(np.int32) @ seen.astype(np.int32)).tocsr()
        order = np.empty(links.shape[0], np.int64)
        order[reverse_cuthill_mckee(links, symmetric_mode=True)] = np.arange(len(order))
        rows, columns = links.nonzero()
        poses_apart = int(np.abs(order[rows] - order[columns]).max(initial=0))
        return cls(_groups(bundle, free, rank, order), order, 6 * poses_apart + 5)


def _groups(bundle: Bundle, free: NDArray[np.bool_], rank: Index, order: Index) -> list[_Group]:
    by_point = np.argsort(bundle.point, kind="stable")
    counts = np.bincount(bundle.point, minlength=len(bundle.points))
    ends = np.cumsum(counts)
    first = np.full(len(counts), len(bundle.centres))
    np.minimum.at(first, bundle.point, bundle.camera)
    last = np.zeros(len(counts), np.int64)
    np.maximum.at(last, bundle.point, bundle.camera)
    out = []
    chosen = np.lexsort((last, first))
    for begin in range(0, len(chosen), GROUP_POINTS):
        points = chosen[begin : begin + GROUP_POINTS]
        observations = np.concatenate([by_point[ends[p] - counts[p] : ends[p]] for p in points])
        cameras, camera = np.unique(bundle.camera[observations], return_inverse=True)
        point = np.repeat(np.arange(len(points)), counts[points])
        places = order[rank[cameras[free[cameras]]]]
        unknowns = (6 * places[:, None] + np.arange(6)).ravel()
        out.append(_Group(points, cameras, observations, camera, point, PoseBlocks.of_poses(free[cameras]), unknowns))
    return out


@dataclass
class _BandedSystem:
    """Normal equations of all free poses, points marginalised; the upper band in the layout of LAPACK."""

    structure: BandedStructure
    parts: list[NormalEquations]
    band: Array
    """[bandwidth + 1, 6 F]"""
    diagonal: Array
    """[6 F], before marginalisation."""
    right: Array
    """[6 F]"""
    cross: Array
    """[6 F, n], cross terms with the free optics."""
    optics: tuple[Array, Array, Array]
    """Hessian [n, n] of the free optics, its right side [n], and its diagonal [n] before marginalisation."""

    @classmethod
    def of(cls, bundle: Bundle, structure: BandedStructure, scale_px: float, damping: float) -> "_BandedSystem":
        width, size = structure.bandwidth, 6 * len(structure.order)
        band, diagonal = np.zeros((width + 1, size)), np.zeros(size)
        free = bundle.free.count
        right, cross, parts = np.zeros(size), np.zeros((size, free)), []
        optics = np.zeros((free, free)), np.zeros(free), np.zeros(free)
        for group in structure.groups:
            part = _of_group(bundle, group).linearise(scale_px, group.blocks, damping)
            hessian, gradient = part.reduced()
            at, count = group.unknowns, len(group.unknowns)
            row, column = at[:, None], at[None, :]
            upper = (row <= column) & (column - row <= width)
            rows, columns = np.nonzero(upper)
            band[width + at[rows] - at[columns], at[columns]] += hessian[rows, columns]
            diagonal[at] += np.diag(part.hessian)[:count]
            right[at] -= gradient[:count]
            cross[at] += hessian[:count, count:]
            own, own_right, own_diagonal = optics
            own += hessian[count:, count:]
            own_right -= gradient[count:]
            own_diagonal += np.diag(part.hessian)[count:]
            parts.append(part)
        return cls(structure, parts, band, diagonal, right, cross, optics)

    def solve(self, damping: float, free: FreeOptics) -> Step:
        """Steps of the poses, the points and the free optics."""
        band = self.band.copy()
        band[-1] += damping * self.diagonal + RIDGE
        solutions = solveh_banded(
            band, np.column_stack([self.right, self.cross]), overwrite_ab=True, check_finite=False
        )
        solution, optics = solutions[:, 0], np.zeros(0)
        if free.count:
            hessian, right, diagonal = self.optics
            damped = hessian + np.diag(damping * diagonal + RIDGE)
            solution, optics = optics_step(solutions, self.cross, damped, right, free.limits)
        points = np.zeros((sum(len(group.points) for group in self.structure.groups), 3))
        for group, part in zip(self.structure.groups, self.parts, strict=True):
            part_solution = np.append(solution[group.unknowns], optics)
            whitened = -part.whitened_gradient - (part.eliminated @ part_solution).reshape(-1, 3)
            points[group.points] = np.einsum("Pji,Pj->Pi", part.roots, whitened)
        blocks = solution.reshape(-1, 6)[self.structure.order]
        return Step(blocks, points, optics)


def _of_group(bundle: Bundle, group: _Group) -> Bundle:
    return replace(
        bundle,
        rotations=bundle.rotations[group.cameras],
        centres=bundle.centres[group.cameras],
        points=bundle.points[group.points],
        camera=group.camera,
        point=group.point,
        pixels=bundle.pixels[group.observations],
    )


def optimise(
    bundle: Bundle,
    iterations: int,
    scale_px: float,
    fixed: NDArray[np.bool_],
    tolerance: float = 1e-4,
    stop: Callable[[], bool] = lambda: False,
) -> float:
    """As `Bundle.optimise`, in time and memory that grow linearly with the number of poses. Changes the bundle.

    Ends after the iteration during which `stop` becomes true.
    """
    free = ~fixed
    structure = BandedStructure.of(bundle, free)

    def attempt(damping: float) -> tuple[float, Bundle]:
        if stop():
            return np.inf, bundle
        try:
            step = _BandedSystem.of(bundle, structure, scale_px, damping).solve(damping, bundle.free)
        except np.linalg.LinAlgError:  # not positive definite: more damping
            return np.inf, bundle
        trial = bundle.stepped(step, free)
        return trial.cost(scale_px), trial

    search = LevenbergMarquardt(damping=1e-3, least_damping=1e-8, iterations=iterations, tolerance=tolerance)
    return search.minimise(bundle.cost(scale_px), attempt, bundle.take)
