"""The focal length, where nobody says it: the first map is tried with several, the adjustment then finds it exactly."""

from dataclasses import dataclass, replace

from spiked.recon.bootstrap import MORE_MOTION, SCALE_PX, Verdict, Views, parallax_px
from spiked.recon.movers import first_map
from spiked.sensor import Intrinsics

FIELDS_OF_VIEW_DEG = (60.0, 42.0, 80.0, 30.0, 100.0)
"""Horizontal fields of view tried, the likeliest first."""
FIRST_DEG = FIELDS_OF_VIEW_DEG[0]
CORRELATED = 10.0
"""Errors of a track last over many views: the focal length is this many times less sure than if they did not (measured
on simulated recordings)."""
UNSURE = 0.05
"""Relative standard deviation of a focal length that a user should not rely on."""


@dataclass(frozen=True)
class Focal:
    """What is known of a focal length that nobody said."""

    intrinsics: Intrinsics
    relative_sigma: float
    """Predicted standard deviation over the value; infinite before the first adjustment."""

    def __str__(self) -> str:
        sure = "is hardly known yet" if self.relative_sigma > 1 else f"is sure to about {self.relative_sigma:.1%}"
        return f"the focal length was not given; {self.intrinsics.fx:.1f} px was estimated and {sure}"


def try_fields(views: Views, seed: int, min_parallax_px: float) -> tuple[Verdict, Intrinsics]:
    """The first map with the focal length that explains the tracks best, and that focal length adjusted with it."""
    width = 2 * views.intrinsics.cx
    tried = [
        replace(views, intrinsics=_with(views.intrinsics, Intrinsics.from_fov(round(width), 1, fov).fx))
        for fov in FIELDS_OF_VIEW_DEG
    ]
    # A camera that turns looks as if it moved when its focal length is wrong: only the least of all counts.
    turning = min(parallax_px(one) for one in tried)
    if turning < min_parallax_px:
        reason = f"parallax {turning:.1f} px is below {min_parallax_px:g} for any focal length: {MORE_MOTION}"
        return Verdict(None, reason, [], views.ids), views.intrinsics
    best: tuple[float, Verdict, Intrinsics] | None = None
    first: Verdict | None = None
    for one in tried:
        verdict = first_map(one, seed, min_parallax_px)
        first = first or verdict
        if verdict.winner is None:
            continue
        bundle = verdict.winner.bundle
        bundle.focal_free = True
        cost = bundle.optimise(30, SCALE_PX, tolerance=1e-4)
        if best is None or cost < best[0]:
            best = cost, verdict, bundle.intrinsics
    if best is None:
        assert first is not None
        return first, views.intrinsics
    return best[1], best[2]


def _with(intrinsics: Intrinsics, focal_px: float) -> Intrinsics:
    return replace(intrinsics, fx=focal_px, fy=focal_px)
