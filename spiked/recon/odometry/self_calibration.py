"""Self-calibration: initialisation tries several focal lengths, adjustments refine them and find distortion.

A distortion that nobody stated shows in the tracks of a whole path: the residuals of a pinhole camera are up to twice
as large. It is taken as k1 and k2 of OpenCV's lens if these explain a large part of the residuals.
"""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from spiked.distortion import Distortion, LensModel
from spiked.errors import ConfigurationError
from spiked.recon.odometry.bundle_adjustment import Bundle
from spiked.recon.odometry.initialisation import (
    INLIER_PX,
    SCALE_PX,
    InitialisationResult,
    LeastParallax,
    Views,
    parallax_px,
)
from spiked.recon.odometry.motion_segmentation import initialise
from spiked.recon.odometry.normal_equations import FreeOptics, PoseBlocks
from spiked.sensor import Intrinsics

FIELDS_OF_VIEW_DEG = (60.0, 42.0, 80.0, 30.0, 100.0)
"""Horizontal fields of view tried, the likeliest first."""
FIELD_TOLERANCE_DEG = 0.25
"""Of the field of view through which turning leaves the least parallax."""
FIRST_DEG = FIELDS_OF_VIEW_DEG[0]
"""Field of view assumed until one was estimated."""
REFINEMENT_ITERATIONS, REFINEMENT_TOLERANCE = 30, 1e-4
"""Of the adjustment with a free focal length that follows each trial."""
OPTICS_ERROR_FACTOR = 10.0
"""True over predicted error of estimated optics, as track errors are correlated over views (simulated recordings)."""
FOCAL_TOLERANCE = 2e-3
"""Relative change of the focal length that counts as stable."""
FIRST_LENSES = (Distortion(LensModel.OPENCV, (-0.3, 0.1)), Distortion(LensModel.FISHEYE, ()))
"""What initialisation tries besides a pinhole camera."""
FIRST_LENS_RATIO = 0.9
"""Cost of an initialisation through a lens over that of a pinhole camera below which it is taken."""
LEAST_LENS_GAIN = 0.01
"""Share of the squared residuals that a distortion has to explain (decision 28)..."""
LEAST_LENS_PX, LEAST_LENS_SIGMAS = 2.0, 3.0
"""... and least displacement of the image's corner by it: px, and standard deviations."""
LENS_TOLERANCE_PX = 0.2
"""Change of the displacement of the image's corner that counts as stable, px."""
OTHER_MODEL_RATIO = 0.99
"""Cost of an adjustment with the other model of a lens over that with the present one below which it is taken."""
LENS_ITERATIONS = 20
"""Of the adjustment in which a distortion is found."""
MAX_FOCAL_SIGMA, MAX_LENS_SIGMA_PX = 0.05, 10.0
"""Relative standard deviation of the focal length above which the path is degraded, and that of the distortion at the
image's corner in px."""


@dataclass(frozen=True)
class Focal:
    """Estimate of a focal length that was not given."""

    ADVICE: ClassVar[str] = "give --fov or --intrinsics if you know it"
    intrinsics: Intrinsics
    relative_sigma: float
    """Predicted standard deviation over the value; infinite before the first adjustment."""

    def __str__(self) -> str:
        sigma = "more than 100%" if self.relative_sigma > 1 else f"about {self.relative_sigma:.1%}"
        value = f"{self.intrinsics.fx:.1f} px, standard deviation {sigma}"
        return f"the focal length was not given and was estimated: {value}"


@dataclass(frozen=True)
class EstimatedLens:
    """Estimate of a distortion that was not given."""

    ADVICE: ClassVar[str] = "give --distortion, or measure it by `spiked calibrate --board`"
    intrinsics: Intrinsics
    corner_sigma_px: float
    """Standard deviation of the displacement of the image's corner."""

    @property
    def corner_px(self) -> float:
        """Displacement of the image's corner by the distortion."""
        return corner_px(self.intrinsics)

    def __str__(self) -> str:
        lens = self.intrinsics.distortion
        assert lens is not None
        named = lens.named()
        return (
            f"the lens distorts, which was not given and was estimated: {lens.model}, k1 {named['k1']:.3f}, "
            f"k2 {named['k2']:.3f}, "
            f"{self.corner_px:.1f} px at the corner, standard deviation about {self.corner_sigma_px:.1f} px"
        )


def corner_px(intrinsics: Intrinsics) -> float:
    """How far the distortion displaces the image's corner, the centre taken to be the middle of the image."""
    corner = np.zeros(2)
    return float(np.linalg.norm(intrinsics.undistorted(corner) - corner))


def estimates(bundle: Bundle) -> tuple[Focal | None, EstimatedLens | None]:
    """The free optics of an adjusted bundle with their standard deviations."""
    covariance = OPTICS_ERROR_FACTOR**2 * bundle.optics_covariance(SCALE_PX)
    focal = lens = None
    if bundle.free.focal:
        focal = Focal(bundle.intrinsics, float(np.sqrt(covariance[0, 0])))
    if bundle.free.radial:
        k = bundle.intrinsics
        assert k.distortion is not None
        by_k = np.array([[k.fx], [k.fy]]) * k.distortion.by_radial(k.unproject(np.zeros(2))[:2])
        lens = EstimatedLens(k, float(np.sqrt((by_k.T * (by_k.T @ covariance[-2:, -2:])).sum())))
    return focal, lens


def optics_moved(before: Intrinsics, after: Intrinsics) -> bool:
    """Whether focal length or distortion changed by more than their tolerance."""
    focal = abs(np.log(after.fx / before.fx)) > FOCAL_TOLERANCE
    return bool(focal or abs(corner_px(after) - corner_px(before)) > LENS_TOLERANCE_PX)


def try_optics(
    views: Views, seed: int, least: LeastParallax, focal_known: bool
) -> tuple[InitialisationResult, Intrinsics]:
    """Initialise as a pinhole camera and through a lens, with each field of view if the focal length is not known.

    Returns the result of the lowest cost and its intrinsics, those of a lens only if its cost is clearly lower. Started
    as a pinhole camera, tracks of a lens with little rotation converge to a bent scene and another path, which no
    adjustment leaves (decision 28).
    """
    starts = [views]
    if not focal_known:
        starts = [replace(views, intrinsics=_with_field(views.intrinsics, fov)) for fov in FIELDS_OF_VIEW_DEG]
        turning = _least_parallax_px(views)
        if turning < least.px:
            reason = f"parallax {turning:.1f} px is below {least.px:g} for any focal length"
            return InitialisationResult(None, reason, [], views.ids, needs_motion=True), views.intrinsics
    results = [initialise(one, seed, least) for one in starts]
    straight = _best(results, FreeOptics(focal=not focal_known))
    if straight is None:
        return results[0], views.intrinsics
    lenses = [
        replace(one, intrinsics=replace(one.intrinsics, distortion=lens)) for lens in FIRST_LENSES for one in starts
    ]
    results = [initialise(one, seed, least) for one in lenses if not one.intrinsics.folds]
    bent = _best(results, FreeOptics(focal=not focal_known, radial=True))
    if bent is None or bent.cost > FIRST_LENS_RATIO * straight.cost or corner_px(bent.intrinsics) < LEAST_LENS_PX:
        return straight.result, straight.intrinsics
    return bent.result, bent.intrinsics


def _least_parallax_px(views: Views) -> float:
    """Parallax through the focal length that leaves the least: a wrong one turns rotation into apparent parallax."""

    def left_px(fov_deg: float) -> float:
        return parallax_px(replace(views, intrinsics=_with_field(views.intrinsics, fov_deg)))

    fields = sorted(FIELDS_OF_VIEW_DEG)
    trials = [left_px(fov) for fov in fields]
    best = int(np.argmin(trials))
    around = fields[max(best - 1, 0)], fields[min(best + 1, len(fields) - 1)]
    found = minimize_scalar(left_px, bounds=around, method="bounded", options={"xatol": FIELD_TOLERANCE_DEG})
    return min(trials[best], float(found.fun))


@dataclass(frozen=True)
class _Trial:
    cost: float
    result: InitialisationResult
    intrinsics: Intrinsics


def _best(results: list[InitialisationResult], free: FreeOptics) -> _Trial | None:
    """The result of the lowest cost after an adjustment with free optics; None if all have failed."""
    trials = []
    for result in results:
        if result.winner is None:
            continue
        bundle, cost = result.winner.bundle, result.winner.cost
        bundle.free = free
        if free.count:
            cost = bundle.optimise(REFINEMENT_ITERATIONS, SCALE_PX, tolerance=REFINEMENT_TOLERANCE)
        trials.append(_Trial(cost, result, bundle.intrinsics))
    return min(trials, key=lambda one: one.cost, default=None)


def _with_field(intrinsics: Intrinsics, fov_deg: float) -> Intrinsics:
    focal_px = Intrinsics.from_fov(round(2 * intrinsics.cx), 1, fov_deg).fx
    return replace(intrinsics, fx=focal_px, fy=focal_px)


def find_distortion(bundle: Bundle) -> Bundle | None:
    """An adjusted bundle without distortion adjusted again with a free lens; None if that explains too little.

    The predicted gain is looked at first (a score test): that takes one set of normal equations.
    """
    open_lens = replace(bundle, free=replace(bundle.free, radial=True))
    hessian, gradient = open_lens.linearise(SCALE_PX, PoseBlocks.of_poses(_all_but_first(bundle))).of_optics()
    square = np.minimum((bundle.residuals() ** 2).sum(1), INLIER_PX**2).sum()
    if gradient @ np.linalg.solve(hessian, gradient) < LEAST_LENS_GAIN * square:
        return None
    before = bundle.cost(SCALE_PX)
    after = open_lens.optimise(LENS_ITERATIONS, SCALE_PX, tolerance=REFINEMENT_TOLERANCE)
    _, lens = estimates(open_lens)
    assert lens is not None
    seen = lens.corner_px > max(LEAST_LENS_PX, LEAST_LENS_SIGMAS * lens.corner_sigma_px)
    return open_lens if seen and after < (1 - LEAST_LENS_GAIN) * before else None


def try_other_model(bundle: Bundle) -> None:
    """Give an adjusted bundle with an estimated lens the other model, if that fits clearly better."""
    k = bundle.intrinsics
    assert k.distortion is not None
    other = LensModel.FISHEYE if k.distortion.model is LensModel.OPENCV else LensModel.OPENCV
    try:
        lens = k.distortion.as_model(other, float(np.linalg.norm(k.unproject(np.zeros(2))[:2])))
    except ConfigurationError:
        return  # it cannot bend like that
    tried = replace(bundle, intrinsics=replace(k, distortion=lens))
    cost = bundle.cost(SCALE_PX)
    if tried.optimise(LENS_ITERATIONS, SCALE_PX, tolerance=REFINEMENT_TOLERANCE) < OTHER_MODEL_RATIO * cost:
        bundle.take(tried)


def _all_but_first(bundle: Bundle) -> NDArray[np.bool_]:
    free = np.ones(len(bundle.centres), bool)
    free[0] = False
    return free
