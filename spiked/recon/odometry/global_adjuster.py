"""Global bundle adjustment: the path as a spline, adjusted to the tracks of the whole recording."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from spiked.pose import Array, log_so3, mean_rotation
from spiked.recon.odometry.bundle_adjustment import Bundle
from spiked.recon.odometry.initialisation import BOOT_VIEWS, INLIER_PX, SCALE_PX
from spiked.recon.odometry.pnp import LOST_CHI2, MIN_POINTS, chi2_of, noise_outside_px
from spiked.recon.odometry.self_calibration import (
    EstimatedLens,
    estimates,
    find_distortion,
    optics_moved,
    try_other_model,
)
from spiked.recon.odometry.sparse_map import MapBundle, Pose, SparseMap, TrackedView
from spiked.recon.odometry.spline_fitting import MotionBursts, fit_coarsest_spline, knot_time_warp, motion_bursts
from spiked.recon.odometry.stationarity import STILL_PX
from spiked.recon.odometry.tracking_state import State
from spiked.recon.odometry.uncertainty import path_error
from spiked.recon.statistics import median
from spiked.spline import Spline

SPLINE_SCALE_PX = SCALE_PX / 2
"""Scale of the robust loss where the poses lie on a spline."""
TOLERANCE = 1e-3
"""Relative gain of an iteration below which an adjustment ends."""
GROWTH, LEAST_NEW_VIEWS = 1.5, 12
"""The next global adjustment comes after 1.5 times as many views, and at least 12 more."""
SLOW_FRAMES = 16
"""Views shorter than this see fast motion."""
MAX_FOCAL_ROUNDS = 4
"""Global adjustments at the end, at most, until estimated optics are stable."""
MAX_TRACK_RMS_RATIO = 1.25
"""Tracks with a larger RMS residual, relative to the median track, are left out when the optics are adjusted."""
MIN_FOCAL_TRACKS = 3 * MIN_POINTS
"""Tracks that each view keeps then: otherwise none is left out."""
OUTLIER_NEIGHBOURS = 2
"""Views on either side that an outlier pulls with it on the spline: among these only the worst is rejected."""
MOTION_CLIP, EVEN_SHARE = 2.0, 0.3
"""Selected views are spaced by image motion, clipped to this many medians, plus this share of the mean motion."""
PATH_ERROR_FACTOR = 5.0
"""True over predicted path error, because errors of a track are correlated over views: 4.0 to 7.3 (decision 7)."""


@dataclass(frozen=True)
class AdjustmentEffort:
    """Size of a global bundle adjustment."""

    views: int
    """Most views adjusted."""
    free_views: int
    """Most views in the first part, in which each has a free pose: its time grows with their cube."""
    rounds: int
    """Most iterations of each part."""


FULL_EFFORT, INTERIM_EFFORT = AdjustmentEffort(100, 100, 8), AdjustmentEffort(32, 16, 3)
"""Fast motion and the final adjustment use the full effort: with 32 free views garden_fast had 4 % ATE, and forward
motion an RPE of 0.011 instead of 0.003 degrees over 32 frames."""


@dataclass
class GlobalAdjuster:
    """The spline of a map's path, and the adjustments that keep both up to date."""

    map: SparseMap
    spline: Spline | None = None
    """The path in frames; None before the first adjustment."""
    interpolated: bool = False
    """Views are too far apart for a spline: there are no global adjustments."""
    closures: list[tuple[float, float]] = field(default_factory=list)
    """None: loops are searched on long paths only."""
    _newest: tuple[Bundle, Array] | None = None
    """Bundle and times of the newest adjustment."""
    _next_count: int = 0
    """Number of views at which the next adjustment is due."""

    @property
    def end_left(self) -> float:
        """See `PathAdjuster.end_left`: `finish` is one piece."""
        return 1.0

    @property
    def reference_views(self) -> list[TrackedView]:
        """None: the newest views are adjusted to those just before them."""
        return []

    @property
    def newest_keyframe(self) -> TrackedView | None:
        """None: the whole path is adjusted."""
        return None

    @property
    def due(self) -> bool:
        """Whether the map has grown enough since the last adjustment."""
        return len(self.map.views) >= self._next_count

    def adjust(self, final: bool = True) -> None:
        """Adjust the whole path: first with a free pose a view, then in the knots of the coarsest spline that fits.

        Without `final`, slow motion uses `INTERIM_EFFORT`; outlier views among these repeat it with `FULL_EFFORT`.
        """
        if self.interpolated:
            return
        views = self.map.views
        self._next_count = max(len(views) + LEAST_NEW_VIEWS, int(GROWTH * len(views)))
        fast = any(view.length < SLOW_FRAMES for view in views[-1:])
        effort = FULL_EFFORT if final or fast else INTERIM_EFFORT
        while len(posed := self.map.posed()) >= BOOT_VIEWS:
            found = self._solve(posed, effort)
            if found is None:
                return
            outliers = _outlier_views(found.adjusted)
            if not outliers or len(posed) - len(outliers) < BOOT_VIEWS:
                self._take(found, effort)
                return
            if effort is FULL_EFFORT:  # the interim effort has too few views to reject any
                for view in outliers:  # blurred views with wrong poses would bend the path
                    view.pose, view.state = None, State.LOST
            effort = FULL_EFFORT

    def finish(
        self,
        stop: Callable[[], bool] = lambda: False,
        save: Callable[[], None] = lambda: None,
        preliminary: bool = False,
    ) -> None:
        """The last adjustments: estimated optics may need several. Ends after one if `stop` is true. They are
        one piece, whatever is `preliminary`: `save` is not called."""
        del save, preliminary
        self.adjust()
        for _ in range(MAX_FOCAL_ROUNDS):
            before = self.map.intrinsics
            if not self.map.free_optics.count or self.spline is None or stop():
                return
            self.adjust()
            if not optics_moved(before, self.map.intrinsics):
                return

    def path_error(self) -> float | None:
        """Predicted error of the path relative to its RMS radius; None without a spline."""
        if self._newest is None or self.spline is None or self.interpolated:
            return None
        bundle, times = self._newest
        return PATH_ERROR_FACTOR * path_error(bundle, self.spline, times, SPLINE_SCALE_PX)

    def information(self) -> Array | None:
        """Information of the tracks on `spline`, points marginalised; None before the first adjustment.

        [6 knots, 6 knots], inverse covariance of (left rotation vector, centre) for independent track errors.
        """
        if self._newest is None or self.spline is None or not len(self._newest[0].camera):
            return None
        bundle, times = self._newest
        noise_px = max(bundle.noise_px(), 1e-3)
        return np.asarray(bundle.spline_information(self.spline, times, SPLINE_SCALE_PX) / noise_px**2)

    def _solve(self, posed: list[TrackedView], effort: AdjustmentEffort) -> "_Solution | None":
        """Spline and adjusted bundle of some of the views; None with too few observations.

        Points and optics of the map take the result of the free poses, the start of the spline.
        """
        views = _select_views(posed, effort.views)
        start = self._free_pose_ba(_select_views(views, effort.free_views), effort.rounds)
        made = self.map.bundle(views)
        if start is None or made is None:
            return None
        every = made.ids
        made.bundle.rotations, made.bundle.centres = start.poses(made.times)
        made.bundle.free = self.map.free_optics
        if self.map.free_optics.count:
            made = _without_worst_tracks(made)
        spline, _ = made.bundle.optimise_spline(start, made.times, effort.rounds, SPLINE_SCALE_PX, TOLERANCE)
        return _Solution(spline, made, np.setdiff1d(every, made.ids))

    def _free_pose_ba(self, views: list[TrackedView], rounds: int) -> Spline | None:
        """Adjust points and free poses of some views; keep the points, return the coarsest spline through the poses."""
        made = self.map.bundle(views)
        if made is None:
            return None
        bundle = made.bundle
        bundle.free = self.map.free_optics
        bundle.optimise(rounds, SCALE_PX, tolerance=TOLERANCE)
        if not self.map.lens_known and self.map.lens is None:
            self._look_for_distortion(bundle)
        elif bundle.free.radial:
            try_other_model(bundle)
        self.map.points[made.ids] = bundle.points
        self.map.take_optics(bundle)
        return _coarsest_spline(self.map.views, made)

    def _look_for_distortion(self, bundle: Bundle) -> None:
        """Let the lens of the map be estimated from now on if an adjusted bundle shows one; changes the bundle then."""
        found = find_distortion(bundle)
        if found is not None:
            bundle.take(found)
            self.map.lens = EstimatedLens(found.intrinsics, np.inf)
            self.map.points[:] = np.nan  # of a pinhole camera; `bundle` has those that are known now

    def _take(self, found: "_Solution", effort: AdjustmentEffort) -> None:
        """Take over spline, poses, points and optics of an adjustment; the other views move to the spline."""
        sparse_map, adjusted, bundle = self.map, found.adjusted, found.adjusted.bundle
        sparse_map.noise_px = bundle.noise_px()
        if bundle.free.count:
            sparse_map.points[found.left_out] = np.nan  # triangulated again below with the new path
            sparse_map.focal, sparse_map.lens = estimates(bundle)
            sparse_map.intrinsics = bundle.intrinsics
        self.spline = _align_to_previous(found.spline, adjusted)
        self._newest = bundle, adjusted.times
        sparse_map.apply(adjusted)
        inside = {view.id for view in adjusted.views}
        others = [view for view in sparse_map.posed() if view.id not in inside]
        if others:
            poses = zip(*self.spline.poses([view.time for view in others]), strict=True)
            for view, (rotation, centre) in zip(others, poses, strict=True):
                view.pose = Pose(rotation, centre)
        sparse_map.triangulate(sparse_map.views[-2 * effort.views :])


@dataclass(frozen=True)
class _Solution:
    spline: Spline
    adjusted: MapBundle
    left_out: NDArray[np.int64]
    """Ids of points that were not adjusted, see `_without_worst_tracks`."""


def _select_views(posed: list[TrackedView], most: int) -> list[TrackedView]:
    """At most `most` of these views, with the first and the last, spaced by image motion."""
    if len(posed) <= most:
        return posed
    motion = np.array([view.motion_px for view in posed])
    path = np.cumsum(np.minimum(motion, MOTION_CLIP * np.median(motion)) + EVEN_SHARE * motion.mean() + 1e-3)
    at = np.searchsorted(path, np.linspace(path[0], path[-1], most)).clip(0, len(posed) - 1)
    return [posed[int(k)] for k in np.unique(at)]


def _outlier_views(adjusted: MapBundle) -> list[TrackedView]:
    """Views whose points contradict their pose after an adjustment (chi2 above `LOST_CHI2`)."""
    bundle, views = adjusted.bundle, adjusted.views
    size, noise_px = np.linalg.norm(bundle.residuals(), axis=1), bundle.noise_px()
    chi2 = np.zeros(len(views))
    for row, view in enumerate(views):
        seen = size[bundle.camera == row]
        if len(seen):
            chi2[row] = chi2_of(median(seen), noise_outside_px(noise_px, view.timing_sigma_px))
    width = 2 * OUTLIER_NEIGHBOURS + 1
    around = np.lib.stride_tricks.sliding_window_view(np.pad(chi2, OUTLIER_NEIGHBOURS), width).max(1)
    return [view for view, own, most in zip(views, chi2, around, strict=True) if own > LOST_CHI2 and own == most]


def _without_worst_tracks(made: MapBundle) -> MapBundle:
    """Without the tracks of the largest RMS residual; unchanged if a view would keep too few.

    Tracks on edges and occlusion boundaries have errors correlated over many views: with them the focal length of
    living was 3.2 % off, without them 2.2 %.
    """
    bundle, count = made.bundle, len(made.ids)
    seen = np.bincount(bundle.point, minlength=count)
    square = np.minimum((bundle.residuals() ** 2).sum(1), INLIER_PX**2)
    rms = np.sqrt(np.bincount(bundle.point, square, count) / np.maximum(seen, 1))
    keep = rms[bundle.point] < MAX_TRACK_RMS_RATIO * np.median(rms)
    if np.bincount(bundle.camera[keep], minlength=len(made.views)).min() < MIN_FOCAL_TRACKS:
        return made
    return made.select(keep)


def _align_to_previous(spline: Spline, adjusted: MapBundle) -> Spline:
    """Align an adjusted path and its points with the views' previous poses by a similarity: a map stays valid."""
    bundle, previous = adjusted.bundle, [view.pose for view in adjusted.views if view.pose is not None]
    old_centres, old_rotations = np.stack([p.centre for p in previous]), np.stack([p.rotation for p in previous])
    rotation = mean_rotation(old_rotations @ bundle.rotations.swapaxes(1, 2))
    a, b = bundle.centres @ rotation.T, old_centres
    middle_a, middle_b = a.mean(0), b.mean(0)
    scale = ((a - middle_a) * (b - middle_b)).sum() / max(((a - middle_a) ** 2).sum(), 1e-12)

    def transform(points: Array) -> Array:
        return np.asarray(scale * (points @ rotation.T - middle_a) + middle_b)

    bundle.points, bundle.centres = transform(bundle.points), transform(bundle.centres)
    bundle.rotations = rotation @ bundle.rotations
    return replace(spline, rotations=rotation @ spline.rotations, centres=transform(spline.centres))


def _coarsest_spline(views: list[TrackedView], adjusted: MapBundle) -> Spline:
    """The coarsest spline over all views of a map that follows the free poses of some of them."""
    bundle, times = adjusted.bundle, adjusted.times
    margin = 0.5 * max(view.length for view in views)
    span = (views[0].time - margin, views[-1].time + margin)
    still = np.array([view.motion_px < STILL_PX for view in views])
    time_warp = knot_time_warp(np.array([view.time for view in views]), still, _bursts(times, bundle))
    hessians = bundle.pose_hessians(SCALE_PX)
    return fit_coarsest_spline(times, bundle.rotations, bundle.centres, hessians, len(bundle.camera), span, time_warp)


def _bursts(times: Array, bundle: Bundle) -> MotionBursts:
    """Spans between the bundle's views, at `times`, in which the camera moved much faster than around them."""
    turns = np.linalg.norm(log_so3(bundle.rotations[1:] @ bundle.rotations[:-1].swapaxes(1, 2)), axis=1)
    local = (bundle.points[bundle.point] - bundle.centres[bundle.camera])[:, None] @ bundle.rotations[bundle.camera]
    shifts = np.linalg.norm(np.diff(bundle.centres, axis=0), axis=1) / max(np.median(local[:, 0, 2]), 1e-6)
    return motion_bursts(times, bundle.intrinsics.fx * (turns + shifts))
