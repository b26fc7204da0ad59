"""Selects the views of the initialisation, decides when to attempt it, and starts the map from its result."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np

from spiked.recon.odometry.initialisation import (
    BOOT_VIEWS,
    FULL_PARALLAX,
    INLIER_PX,
    LEAST_INLIERS,
    ROUGH_PARALLAX,
    InitialisationResult,
    LeastParallax,
    Views,
)
from spiked.recon.odometry.motion_segmentation import initialise
from spiked.recon.odometry.pnp import MIN_POINTS, fit_pose
from spiked.recon.odometry.self_calibration import EstimatedLens, try_optics
from spiked.recon.odometry.sparse_map import Pose, SparseMap, TrackedView
from spiked.recon.odometry.stationarity import STILL_PX, STOOD_PX, moving_object_share
from spiked.recon.odometry.tracking_state import State, TrackingState

MIN_COMMON_TRACKS = 60
"""Tracks that span the views of a bootstrap; below, the first view of the attempt moves forward."""
ATTEMPT_EVERY = 3
"""Views between attempts."""
NEXT_PARALLAX_SHARE, NEXT_VIEWS_RATIO = 0.8, 1.2
"""After a full attempt, which is expensive, the next one needs this share of the parallax that was missing and this
many times the views."""
MOVE_NOW, MOVE_AGAIN = "move the camera sideways", "record again while the camera moves sideways"
"""Advice where parallax is missing, for a live camera and for a recording."""


@dataclass
class Initialiser:
    """Attempts of the initialisation on the views of a map without poses."""

    map: SparseMap
    status: TrackingState
    seed: int = 0
    live: bool = False
    """The camera is live: reasons advise how to move it."""
    _start: int = 0
    """Id of the first view of the next attempt."""
    _least: LeastParallax = FULL_PARALLAX
    _min_views: int = 0
    _alone: bool = True
    """There is no other map of views before."""
    rough: bool = False
    """The map was begun with `ROUGH_PARALLAX`."""

    def attempt(self, final: bool = False, stood: bool = True) -> bool:
        """Attempt after a new view, if there are enough of them and enough new ones; `final`: it is the last one. Views
        before the camera `stood` still are left out.

        Returns whether the map was initialised: then all views from the first of the attempt on have poses.
        """
        if self._start < len(self.map.views):  # a second map may have no view yet
            self._move_start(stood)
        views = self.map.views[self._start :]
        count, time = len(views), self.map.views[-1].time
        advice = MOVE_NOW if self.live and not final else MOVE_AGAIN
        if count < BOOT_VIEWS:
            after = f" since the camera last stood still, at view {self._start + 1}" if self._start else ""
            what = f": {advice}" if self.live or final else ""  # a recording may have more views
            self.status.explain(f"{count} of {BOOT_VIEWS} views for a first map{after}{what}")
            return False
        if (count % ATTEMPT_EVERY or count < self._min_views) and not final:
            return False
        chosen = _equal_flow(views)
        result = self._solve(chosen)
        if result.winner is None:
            if result.tried:
                self._least = replace(
                    self._least, px=max(FULL_PARALLAX.px, NEXT_PARALLAX_SHARE * result.wanted_parallax_px)
                )
                self._min_views = int(NEXT_VIEWS_RATIO * count) + 1
            self.status.set(time, State.BOOT, f"{result.reason}: {advice}" if result.needs_motion else result.reason)
            return False
        self._start_map(chosen, result)
        agree = f"{result.winner.inliers:.0%} of the tracks agree"
        self.status.set(time, State.TRACK, f"bootstrap from {count} views, {agree}")
        self.map.triangulate(views)
        return True

    def begin_at(self, view: int) -> None:
        """Initialise from this view on: those before are in another map."""
        self._start, self._alone = view, False

    def last_attempt(self) -> bool:
        """Attempt after the last view; if it fails, the reason says why the recording has no path."""
        count = len(self.map.views)
        if count < BOOT_VIEWS:
            self.status.explain(f"the recording is too short: {count} views, a first map needs {BOOT_VIEWS}")
        elif self.attempt(final=True):
            return True
        reason, stationary = self.status.reason, self._stationary_reason()
        if count >= BOOT_VIEWS and stationary is None:
            self.rough = self._rough_attempt()
        if not self.rough:
            self.status.explain(stationary or reason)
        return self.rough

    def _rough_attempt(self) -> bool:
        """With as little parallax as tells depths at all, from the first view on that shares tracks with the newest: a
        rough path is better than none.

        Not without a focal length: turning looks like this parallax through a wrong one.
        """
        if not self._alone or self.map.focal is not None:
            return False
        self._start, self._least = 0, ROUGH_PARALLAX
        return self.attempt(final=True, stood=False)

    def _move_start(self, stood: bool) -> None:
        """Move the first view forward until it shares tracks with the newest, and behind a standstill if it `stood`."""
        views, newest = self.map.views, self.map.views[-1]
        common = np.intersect1d(views[self._start].ids, newest.ids)
        while len(common) < MIN_COMMON_TRACKS and self._start < len(views) - BOOT_VIEWS:
            self._start += 1
            common = np.intersect1d(views[self._start].ids, newest.ids)
            self._min_views = 0
        if stood and len(common) >= MIN_COMMON_TRACKS and self._start < newest.id:
            moved = np.linalg.norm(newest.pixels_of(common) - views[self._start].pixels_of(common), axis=1)
            if np.median(moved) < STOOD_PX:
                self._start, self._min_views = newest.id, 0

    def _solve(self, chosen: Sequence[TrackedView]) -> InitialisationResult:
        """Initialise from some views; unknown optics are estimated and set."""
        common = reduce(np.intersect1d, [view.ids for view in chosen])
        pixels = np.stack([view.pixels_of(common) for view in chosen])
        views = Views(pixels, common, self.map.intrinsics)
        if self.map.lens_known or self.map.lens is not None or self._least is ROUGH_PARALLAX:
            return initialise(views, self.seed, self._least)
        known = self.map.focal is None
        result, self.map.intrinsics = try_optics(views, self.seed, self._least, focal_known=known)
        if self.map.intrinsics.distortion is not None:
            self.map.lens = EstimatedLens(self.map.intrinsics, np.inf)
        return result

    def _start_map(self, chosen: Sequence[TrackedView], result: InitialisationResult) -> None:
        """Set points, noise and the poses of all views from a successful initialisation."""
        assert result.winner is not None
        bundle, self.map.noise_px = result.winner.bundle, result.winner.noise_px()
        error = np.linalg.norm(bundle.residuals().reshape(len(chosen), -1, 2), axis=2)
        good = np.median(error, 0) < INLIER_PX
        self.map.points[result.ids[good]] = bundle.points[good]
        for view, rotation, centre in zip(chosen, bundle.rotations, bundle.centres, strict=True):
            view.pose = Pose(rotation, centre)
        self._pose_others(chosen)

    def _pose_others(self, chosen: Sequence[TrackedView]) -> None:
        """PnP of the views between the chosen ones, and of those before them as far as their points agree."""
        views, ids = self.map.views, np.array([view.id for view in chosen])
        for view in views[self._start :]:
            if view.pose is None:
                near = chosen[int(np.argmin(np.abs(ids - view.id)))].pose
                assert near is not None
                fit_pose(self.map, view, near).store(view)
        for view in reversed(views[: self._start]):
            after = views[view.id + 1].pose
            assert after is not None
            fit = fit_pose(self.map, view, after)
            if fit.points < MIN_POINTS or fit.inliers < LEAST_INLIERS:
                break
            fit.store(view)

    def _stationary_reason(self) -> str | None:
        """Why a recording of a camera that did not move has no path; None if it moved."""
        share = moving_object_share([(view.ids, view.pixels) for view in self.map.views])
        if share is None:
            return None
        # Objects too fast or too small to be tracked may have moved.
        moves = f"only an object moves ({share:.0%} of the tracks)" if share else "nothing that can be followed moves"
        return f"the camera stood still and {moves}, while a path needs its own motion: {MOVE_AGAIN}"


def _equal_flow(views: Sequence[TrackedView]) -> list[TrackedView]:
    """At most BOOT_VIEWS views, the first and the newest among them, with about equal motion between them."""
    motion = np.array([view.motion_px for view in views])
    motion[0] = 0
    path = np.cumsum(np.where(motion < STILL_PX, 0, motion) + 1e-3)
    at = np.searchsorted(path, np.linspace(path[0], path[-1], BOOT_VIEWS)).clip(0, len(path) - 1)
    return [views[int(k)] for k in np.unique(at)]
