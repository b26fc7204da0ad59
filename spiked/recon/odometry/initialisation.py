"""Initialisation: joint adjustment of a few views from several starts; the lowest robust cost wins.

One start often converges to the depth-reversed scene. Several starts, and the mirror image of the best result
(translations negated, inverse depths mirrored about their median), avoid that.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

import cv2
import numpy as np
from numpy.typing import NDArray

from spiked.pose import Array
from spiked.recon.odometry.bundle_adjustment import Bundle
from spiked.sensor import Intrinsics

BOOT_VIEWS = 10
"""Views of an initialisation, spaced by equal image motion, and fewest views of a path."""
SCALE_PX = 0.3
"""Scale of the Cauchy loss: tracks on spike-aligned rates are good to about 0.05 px."""
INLIER_PX = 1.0
"""Largest reprojection error of an inlier."""
LEAST_INLIERS = 0.6
"""Share of inliers that an initialisation needs."""
SAME_SCENE_CORRELATION = 0.8
"""Correlation of inverse depths above which two results are the same scene."""
WORSE_RATIO = 1.1
"""Cost of a rival over the best one above which it is worse..."""
WORSE_T_RATIO, WORSE_T = 1.02, 5.0
"""... or above this smaller ratio, if a paired t-test over the tracks gives at least this t value."""
MIN_TRACKS = 30
"""Tracks through all views that an initialisation needs."""
RANDOM_INVERSE_DEPTHS = (0.5, 1.5)
"""Range of the random start."""
COARSE_SEARCH, FINE_ITERATIONS, FINE_TOLERANCE = (15, 2.0), 40, 1e-3
"""Iterations and scale in px of the first adjustment of a start; iterations and tolerance of the second."""
RANSAC_CONFIDENCE, ESSENTIAL_INLIER_PX, PNP_INLIER_PX = 0.999, 0.5, 3.0
"""Of the five-point start: probability of a sample without outliers, and largest errors of inliers of the essential
matrix and of the poses between, whose points are still rough."""
MIN_FIVE_POINT_TRACKS, DEPTH_LIMITS = 12, (0.05, 1e3)
"""Points that this start needs, and the depths that they may have, in baselines."""
INVERSE_DEPTH_RATIOS = (0.1, 10)
"""Limits of an inverse depth over the median one where they are compared and mirrored."""
MIRROR_BETTER_RATIO = 0.98
"""Cost of the depth-reversed result over the best one below which it takes its place."""


class Guess(StrEnum):
    """The start of a hypothesis."""

    FLAT = "flat"
    RANDOM = "random"
    FIVE_POINT = "five_point"
    MIRROR = "mirror"


@dataclass(frozen=True)
class LeastParallax:
    """Parallax (image motion beyond rotation) that a bootstrap needs."""

    px: float = 0.5
    """Tracks are good to 0.05 px (decision 12)."""
    noises: float = 5.0
    """Parallax over the tracks' noise: with less, depths are noise."""


FULL_PARALLAX, ROUGH_PARALLAX = LeastParallax(), LeastParallax(0.15, 2.0)
"""For a path that goes on, and for a recording that ends without one (decision 61)."""


@dataclass(frozen=True)
class Views:
    """Tracks seen in all of K views: `pixels` [K, P, 2]; `ids` [P] name them."""

    pixels: Array
    ids: NDArray[np.int64]
    intrinsics: Intrinsics

    def rays(self) -> Array:
        """Directions with z = 1 in each camera, [K, P, 3]."""
        return self.intrinsics.unproject(self.pixels)


@dataclass(frozen=True)
class Hypothesis:
    """One converged reconstruction of the views, normalised to median depth 1 in the first camera."""

    guess: Guess
    bundle: Bundle
    cost: float
    inliers: float
    """Share of observations within INLIER_PX."""
    parallax_px: float
    """Median over tracks of the largest motion that rotation alone cannot explain."""

    def noise_px(self) -> float:
        """Standard deviation of a track's place in one view and one direction, from the median residual."""
        return self.bundle.noise_px()

    def track_costs(self) -> Array:
        """Mean robust cost of each track, [P]."""
        square = np.minimum((self.bundle.residuals() / SCALE_PX) ** 2, 1e6).sum(1)
        return np.asarray(np.log1p(square).reshape(-1, len(self.bundle.points)).mean(0))


@dataclass(frozen=True)
class InitialisationResult:
    """Result of a bootstrap attempt: a hypothesis, or the reason why there is none yet."""

    winner: Hypothesis | None
    reason: str
    tried: list[Hypothesis]
    ids: NDArray[np.int64]
    """[P], the tracks of the hypotheses."""
    wanted_parallax_px: float = 0.0
    """Parallax needed, if there was too little for the noise of the tracks."""
    needs_motion: bool = False
    """More sideways motion would make the depths observable."""


def bootstrap(views: Views, seed: int = 0, least: LeastParallax = FULL_PARALLAX) -> InitialisationResult:
    """Try all guesses on `views`. Accepts when there is enough parallax for the noise of the tracks, inliers > 60 % and
    every different outcome, the depth-reversed one above all, is clearly worse."""
    if len(views.ids) < MIN_TRACKS:
        return InitialisationResult(
            None, f"only {len(views.ids)} tracks span the views; more texture or light is needed", [], views.ids
        )
    rotation_only = parallax_px(views)
    if rotation_only < least.px:
        reason = f"parallax {rotation_only:.1f} px is below {least.px:g}"
        return InitialisationResult(None, reason, [], views.ids, needs_motion=True)
    rng = np.random.default_rng(seed)
    count = len(views.ids)
    starts: dict[Guess, Callable[[], Bundle | None]] = {
        Guess.FLAT: lambda: _from_depth(views, np.ones(count)),
        Guess.RANDOM: lambda: _from_depth(views, 1 / rng.uniform(*RANDOM_INVERSE_DEPTHS, count)),
        Guess.FIVE_POINT: lambda: _from_five_point(views),
    }
    tried: list[Hypothesis] = []
    for guess, start in starts.items():
        bundle = start()
        if bundle is None:
            continue
        tried.append(_converge(guess, bundle, rotation_only))
        wanted = least.noises * tried[0].noise_px()
        if rotation_only < wanted and tried[0].inliers > LEAST_INLIERS:
            reason = f"parallax {rotation_only:.1f} px is below {wanted:.1f} for tracks this noisy"
            return InitialisationResult(None, reason, tried, views.ids, wanted, needs_motion=True)
    best = min(tried, key=lambda h: h.cost)
    rival = _converge(Guess.MIRROR, _mirrored(views, best.bundle), rotation_only)
    tried.append(rival)
    if rival.cost < best.cost * MIRROR_BETTER_RATIO:
        best = rival
    return _select_hypothesis(best, tried, views.ids)


def _select_hypothesis(best: Hypothesis, tried: list[Hypothesis], ids: NDArray[np.int64]) -> InitialisationResult:
    if best.inliers < LEAST_INLIERS:
        return InitialisationResult(
            None, f"only {best.inliers:.0%} of the tracks agree with one rigid scene", tried, ids
        )
    for rival in tried:
        if (
            rival is not best
            and _inverse_depth_correlation(rival, best) < SAME_SCENE_CORRELATION
            and not _clearly_worse(rival, best)
        ):
            name = "its depth reversal" if _inverse_depth_correlation(rival, best) < 0 else "another one"
            reason = f"the scene and {name} explain the tracks equally well"
            return InitialisationResult(None, reason, tried, ids, needs_motion=True)
    return InitialisationResult(best, "accepted", tried, ids)


def _inverse_depth_correlation(a: Hypothesis, b: Hypothesis) -> float:
    """Correlation of the inverse depths: 1 for the same scene, about -1 where near and far are exchanged."""
    inverse = [1 / np.maximum(h.bundle.points[:, 2], 1e-3) for h in (a, b)]
    near, far = (
        np.clip(q, INVERSE_DEPTH_RATIOS[0] * np.median(q), INVERSE_DEPTH_RATIOS[1] * np.median(q)) for q in inverse
    )
    return float(np.corrcoef(near, far)[0, 1])


def _clearly_worse(rival: Hypothesis, best: Hypothesis) -> bool:
    """Compare the costs, or the mean costs of the tracks by a paired t-test (errors along a track are correlated)."""
    if rival.cost > WORSE_RATIO * best.cost:
        return True
    more = rival.track_costs() - best.track_costs()
    t = more.mean() / max(more.std() / np.sqrt(len(more)), 1e-9)
    return bool(t > WORSE_T and rival.cost > WORSE_T_RATIO * best.cost)


def _converge(guess: Guess, bundle: Bundle, parallax: float) -> Hypothesis:
    bundle.optimise(*COARSE_SEARCH)
    cost = bundle.optimise(FINE_ITERATIONS, SCALE_PX, tolerance=FINE_TOLERANCE)
    depth = float(np.median(bundle.points[:, 2]))
    if depth > 0:
        bundle.points /= depth
        bundle.centres /= depth
    inliers = float(np.mean(np.linalg.norm(bundle.residuals(), axis=1) < INLIER_PX))
    return Hypothesis(guess, bundle, cost, inliers, parallax)


def converge_without(one: Hypothesis, tracks: NDArray[np.bool_]) -> Hypothesis:
    """A hypothesis adjusted anew without some of its `tracks` [P]."""
    bundle = one.bundle
    seen = ~tracks[bundle.point]
    row = np.cumsum(~tracks) - 1
    rest = Bundle(
        bundle.rotations.copy(),
        bundle.centres.copy(),
        bundle.points[~tracks],
        bundle.camera[seen],
        row[bundle.point[seen]],
        bundle.pixels[seen],
        bundle.intrinsics,
    )
    return _converge(one.guess, rest, one.parallax_px)


def _bundle(views: Views, rotations: Array, centres: Array, points: Array) -> Bundle:
    k, p = views.pixels.shape[:2]
    camera, point = np.divmod(np.arange(k * p), p)
    return Bundle(rotations, centres, points, camera, point, views.pixels.reshape(-1, 2).copy(), views.intrinsics)


def _from_depth(views: Views, depth: Array) -> Bundle:
    """Cameras that only rotate, and points at the given depths in the first."""
    rays = views.rays()
    rotations = np.stack([_align(rays[0], rays[k]) for k in range(len(rays))])
    return _bundle(views, rotations, np.zeros((len(rays), 3)), rays[0] * depth[:, None])


def _align(first: Array, other: Array) -> Array:
    """The rotation (camera-to-world, first camera = world) that best carries rays of `other` onto `first` (Kabsch)."""
    a = other / np.linalg.norm(other, axis=1, keepdims=True)
    b = first / np.linalg.norm(first, axis=1, keepdims=True)
    weight = np.ones(len(a))
    rotation = np.eye(3)
    for _ in range(4):
        u, _, vt = np.linalg.svd((b * weight[:, None]).T @ a)
        rotation = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
        error = np.linalg.norm(a @ rotation.T - b, axis=1)
        weight = 1 / (1 + (error / (np.median(error) + 1e-9)) ** 2)
    return np.asarray(rotation)


def parallax_px(views: Views) -> float:
    """Median over tracks of the largest motion left (px) when the views are explained by rotation alone."""
    rays = views.rays()
    left = [rays[k] @ _align(rays[0], rays[k]).T for k in range(1, len(rays))]
    focal = views.intrinsics.fx
    distance = [np.linalg.norm(r[:, :2] / r[:, 2:] - rays[0][:, :2], axis=1) * focal for r in left]
    return float(np.median(np.max(distance, axis=0)))


def _from_five_point(views: Views) -> Bundle | None:
    """Relative pose of the first and last view from the essential matrix, the others by PnP."""
    k = views.intrinsics.matrix()
    seen = views.intrinsics.undistorted(views.pixels)
    first, last = seen[0], seen[-1]
    essential, mask = cv2.findEssentialMat(first, last, k, cv2.RANSAC, RANSAC_CONFIDENCE, ESSENTIAL_INLIER_PX)
    if essential is None or essential.shape != (3, 3):
        return None
    _, r, t, _ = cv2.recoverPose(essential, first, last, k, mask=mask)
    projections = k @ np.eye(3, 4), k @ np.hstack([r, t])
    homogeneous = cv2.triangulatePoints(*projections, first.T, last.T)
    points = (homogeneous[:3] / homogeneous[3]).T
    ok = np.isfinite(points).all(1) & (points[:, 2] > DEPTH_LIMITS[0]) & (points[:, 2] < DEPTH_LIMITS[1])
    if ok.sum() < MIN_FIVE_POINT_TRACKS:
        return None
    points[~ok] = views.rays()[0][~ok] * np.median(points[ok, 2])
    rotations, centres = np.tile(np.eye(3), (len(views.pixels), 1, 1)), np.zeros((len(views.pixels), 3))
    for i in range(1, len(views.pixels)):
        found, rvec, tvec, _ = cv2.solvePnPRansac(points[ok], seen[i][ok], k, None, reprojectionError=PNP_INLIER_PX)
        if not found:
            return None
        rotation = cv2.Rodrigues(rvec)[0].T
        rotations[i], centres[i] = rotation, -rotation @ tvec[:, 0]
    return _bundle(views, rotations, centres, points)


def _mirrored(views: Views, bundle: Bundle) -> Bundle:
    """The depth-reversed start: translations negated, inverse depths mirrored about their median."""
    inverse = 1 / np.maximum(bundle.points[:, 2], 1e-3)
    mirrored = np.clip(2 * np.median(inverse) - inverse, INVERSE_DEPTH_RATIOS[0] * np.median(inverse), None)
    return _bundle(views, bundle.rotations.copy(), -bundle.centres, views.rays()[0] / mirrored[:, None])
