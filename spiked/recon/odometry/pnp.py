"""Pose of one view from known points (PnP), and whether it can be trusted."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

import spiked.native._bundle as _bundle
from spiked.pose import Array
from spiked.recon.odometry.initialisation import INLIER_PX, SCALE_PX
from spiked.recon.odometry.sparse_map import Pose, SparseMap, TrackedView
from spiked.recon.statistics import RAYLEIGH_MEDIAN, median
from spiked.sensor import Intrinsics

LEAST_DEPTH_SCALE = 1e-6
"""Median depth of points behind the camera is taken as this, to predict deviations."""
LEAST_POINTS = 6
"""Known points below which no pose is computed: a pose has six parameters, a point gives two equations."""
FIT_SCALES_PX = (4.0, 2.0, 1.0, *[SCALE_PX] * 5)
"""Scales of the robust loss in the iterations of one pose."""
COUNTED_INLIER_PX = 1.5 * INLIER_PX
"""Largest residual of an inlier of one pose."""
LEAST_NOISE_PX = 0.15
"""Lower bound of the assumed track noise: new points carry errors of this size however clean their tracks are."""
NOISE_MARGIN = 1.3
"""Residual noise of new views over that of the newest global bundle. Medians on the streams: 1.30 (living), 1.48
(garden), 1.55 (camp_color), 1.40 (garden_fast); 80 % of the views lie within 1.1 and 2.0."""
MIN_POINTS = 15
"""Known points that a pose needs: below, tracking is lost; below twice as many it is degraded."""
WORST_CHI2 = 2.5
"""Largest `PnPResult.chi2` of a pose that is not degraded."""
WORST_SIGMA_PX = 1.0
"""Largest predicted standard deviation of such a pose."""
WORST_INLIERS = 0.5
"""Least share of its known points that agree with it."""
WORST_OVERLAP = 0.25
"""Least share of its tracks whose points are known."""
DRAWN_PX, DRAWS = 4.0, 200
"""Largest residual of a match that agrees with a drawn pose, and poses drawn."""
LEAST_DRAWN = 8
"""Matches that agree with a drawn pose."""
LOST_CHI2, LOST_INLIERS = 25.0, 0.35
"""A pose is rejected if points lie 5 times as far off as noise explains, or if a smaller share of them agrees (decision
10)."""


@dataclass(frozen=True)
class PnPResult:
    """Pose of one view from known points."""

    pose: Pose
    inliers: float
    """Share of the points within `COUNTED_INLIER_PX`."""
    points: int
    """Known points in view."""
    chi2: float = 1.0
    """Squared median residual over the expected one; 1 if the noise explains it."""
    sigma_px: float = np.inf
    """Predicted standard deviation of the pose, as image displacement at the median depth."""

    def store(self, view: TrackedView) -> None:
        """Make this the pose of a view."""
        view.pose = self.pose
        self.store_quality(view)

    def store_quality(self, view: TrackedView) -> None:
        """Copy inliers, chi2 and sigma to a view."""
        view.inliers, view.chi2, view.sigma_px = self.inliers, self.chi2, self.sigma_px

    def lost_reason(self) -> str | None:
        """Why the pose is rejected, or None."""
        if self.points < MIN_POINTS or self.inliers < LOST_INLIERS:
            return f"{self.points} known points in view, {self.inliers:.0%} agree with one pose"
        if self.chi2 > LOST_CHI2:
            return f"points lie {np.sqrt(self.chi2):.0f} times as far off as their noise explains"
        return None

    def degraded_reason(self, tracks: int) -> str | None:
        """Why the pose of a view with so many tracks is degraded, or None."""
        if self.inliers < WORST_INLIERS or self.points < 2 * MIN_POINTS:
            return f"{self.points} known points in view, {self.inliers:.0%} agree with one pose"
        if self.sigma_px > WORST_SIGMA_PX:
            return f"the pose is only known to {self.sigma_px:.1f} px: the known points leave much of the view empty"
        if self.chi2 > WORST_CHI2:
            return f"points lie {np.sqrt(self.chi2):.1f} times as far off as their noise explains"
        if self.points < WORST_OVERLAP * tracks:
            return f"only {self.points / tracks:.0%} of the tracks in view have a known position"
        return None


def noise_outside_px(bundle_noise_px: float, timing_sigma_px: float) -> float:
    """Assumed noise of a view's tracks from the residual noise of a bundle and the view's timing errors."""
    return float(np.hypot(max(NOISE_MARGIN * bundle_noise_px, LEAST_NOISE_PX), timing_sigma_px))


def chi2_of(median_px: float, noise_px: float) -> float:
    """Squared median residual over the one expected from this noise in one direction."""
    return float((median_px / (RAYLEIGH_MEDIAN * noise_px)) ** 2)


@dataclass(frozen=True)
class SolvedPose:
    """A pose from points and their pixels, and how well it is determined."""

    pose: Pose
    errors_px: Array
    """[n] distances of the pixels from the projections."""
    hessian: Array
    """[6, 6] of the pose, for a noise of 1 px."""
    displacement_px: float
    """Predicted deviation of the pose as image displacement at the median depth, for a noise of 1 px."""


def solve_pose(
    points: Array, pixels: Array, intrinsics: Intrinsics, start: Pose, scales_px: Sequence[float], move: bool = True
) -> SolvedPose:
    """Robust Gauss-Newton of one pose on points [n, 3] seen at pixels [n, 2]: an iteration for each scale of the loss.

    Without `move` the start is only evaluated.
    """
    k = intrinsics
    rotation, centre = start.rotation.copy(), start.centre.copy()
    errors, hessian = np.empty(len(points)), np.empty((6, 6))
    scales = np.array(scales_px)
    _bundle.fit_pose(
        points, pixels, k.fx, k.fy, k.cx, k.cy, scales, rotation, centre, errors, hessian, move, **k.lens()
    )
    depth = max(median((points - centre) @ rotation[:, 2]), LEAST_DEPTH_SCALE)
    seen_px = _bundle.displacement(hessian, rotation, k.fx, k.fy, k.cx, k.cy, depth)
    return SolvedPose(Pose(rotation, centre), errors, hessian, seen_px)


def draw_pose(points: Array, pixels: Array, intrinsics: Intrinsics) -> tuple[Pose, int] | None:
    """The pose that most of the matches agree with, by three points at a time (AP3P), and how many do.

    points [n, 3] are seen at pixels [n, 2], many of them wrongly. None if fewer than `LEAST_DRAWN` agree.
    """
    good, turn, shift, inliers = cv2.solvePnPRansac(
        points, intrinsics.undistorted(pixels), intrinsics.matrix(), None,
        iterationsCount=DRAWS, reprojectionError=DRAWN_PX, confidence=0.999, flags=cv2.SOLVEPNP_AP3P,
    )  # fmt: skip
    if not good or inliers is None or len(inliers) < LEAST_DRAWN:
        return None
    rotation = cv2.Rodrigues(turn)[0].T
    centre = -rotation @ shift[:, 0]
    return (Pose(rotation, centre), len(inliers)) if np.isfinite(centre).all() else None


def fit_pose(sparse_map: SparseMap, view: TrackedView, start: Pose, move: bool = True) -> PnPResult:
    """Robust Gauss-Newton of one pose on the known points; without `move` the start is only evaluated."""
    points = sparse_map.points[view.ids]
    known = np.isfinite(points[:, 0])
    points, pixels = points[known], view.pixels[known]
    if len(points) < LEAST_POINTS:
        return PnPResult(start, 0.0, len(points))
    scales = FIT_SCALES_PX if move else FIT_SCALES_PX[-1:]
    solved = solve_pose(points, pixels, sparse_map.intrinsics, start, scales, move)
    inliers = float(np.mean(solved.errors_px < COUNTED_INLIER_PX))
    noise = noise_outside_px(sparse_map.noise_px, view.timing_sigma_px)
    chi2 = chi2_of(median(solved.errors_px), noise)
    sigma_px = float(np.sqrt(max(chi2, 1.0)) * noise * solved.displacement_px)
    return PnPResult(solved.pose, inliers, len(points), chi2, sigma_px)
