"""Self-calibration of an unknown focal length: initialisation tries several, bundle adjustment refines it."""

from dataclasses import dataclass, replace

from spiked.recon.odometry.initialisation import SCALE_PX, InitialisationResult, Views, parallax_px
from spiked.recon.odometry.motion_segmentation import initialise
from spiked.sensor import Intrinsics

FIELDS_OF_VIEW_DEG = (60.0, 42.0, 80.0, 30.0, 100.0)
"""Horizontal fields of view tried, the likeliest first."""
FIRST_DEG = FIELDS_OF_VIEW_DEG[0]
"""Field of view assumed until one was estimated."""
REFINEMENT_ITERATIONS, REFINEMENT_TOLERANCE = 30, 1e-4
"""Of the adjustment with a free focal length that follows each trial."""
FOCAL_ERROR_FACTOR = 10.0
"""True over predicted error of the focal length, as track errors are correlated over views (simulated recordings)."""
FOCAL_TOLERANCE = 2e-3
"""Relative change of the focal length that counts as stable."""
MAX_FOCAL_SIGMA = 0.05
"""Relative standard deviation of the focal length above which the path is degraded."""


@dataclass(frozen=True)
class Focal:
    """Estimate of a focal length that was not given."""

    intrinsics: Intrinsics
    relative_sigma: float
    """Predicted standard deviation over the value; infinite before the first adjustment."""

    def __str__(self) -> str:
        sigma = "more than 100%" if self.relative_sigma > 1 else f"about {self.relative_sigma:.1%}"
        value = f"{self.intrinsics.fx:.1f} px, standard deviation {sigma}"
        return f"the focal length was not given and was estimated: {value}"


def try_fields(views: Views, seed: int, min_parallax_px: float) -> tuple[InitialisationResult, Intrinsics]:
    """Initialise with each field of view; returns the result of the lowest cost and its refined intrinsics."""
    width = 2 * views.intrinsics.cx
    tried = [
        replace(views, intrinsics=_with(views.intrinsics, Intrinsics.from_fov(round(width), 1, fov).fx))
        for fov in FIELDS_OF_VIEW_DEG
    ]
    # A wrong focal length turns rotation into apparent parallax: the smallest parallax of all trials counts.
    turning = min(parallax_px(one) for one in tried)
    if turning < min_parallax_px:
        reason = f"parallax {turning:.1f} px is below {min_parallax_px:g} for any focal length"
        return InitialisationResult(None, reason, [], views.ids, needs_motion=True), views.intrinsics
    results = [initialise(one, seed, min_parallax_px) for one in tried]
    best: tuple[float, InitialisationResult, Intrinsics] | None = None
    for result in results:
        if result.winner is None:
            continue
        bundle = result.winner.bundle
        bundle.focal_free = True
        cost = bundle.optimise(REFINEMENT_ITERATIONS, SCALE_PX, tolerance=REFINEMENT_TOLERANCE)
        if best is None or cost < best[0]:
            best = cost, result, bundle.intrinsics
    return (results[0], views.intrinsics) if best is None else best[1:]


def _with(intrinsics: Intrinsics, focal_px: float) -> Intrinsics:
    return replace(intrinsics, fx=focal_px, fy=focal_px)
