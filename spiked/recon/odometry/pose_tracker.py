"""Pose of each new view on a known map: prediction, PnP, relocalisation, triangulation and local bundle adjustment."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spiked.pose import exp_so3, log_so3
from spiked.recon.frontend.feature_tracks import NO_WARPS, Picture, Tracks
from spiked.recon.odometry.initialisation import SCALE_PX
from spiked.recon.odometry.path_adjuster import PathAdjuster
from spiked.recon.odometry.pnp import LOST_CHI2, MIN_POINTS, WORST_CHI2, WORST_INLIERS, PnPResult, fit_pose
from spiked.recon.odometry.relocaliser import Relocaliser
from spiked.recon.odometry.sparse_map import (
    TRIANGULATION_MIN_FAR_VIEWS,
    TRIANGULATION_MIN_VIEWS,
    Pose,
    SparseMap,
    TrackedView,
)
from spiked.recon.odometry.template_warps import template_warps
from spiked.recon.odometry.tracking_state import State, TrackingState

RECENT_VIEWS = 48
"""Newest views from which tracks are triangulated between global adjustments: it bounds the time of one call."""
TRIANGULATE_EVERY, LOCAL_BA_EVERY = 4, 8
"""Views between triangulations and between local bundle adjustments."""
LIVE_STEPS = 3
"""Gauss-Newton steps of a live camera's triangulation: without them it is biased towards the camera (decision 62)."""
FAR_PX = 8.0
"""Image motion to a view, where frames were skipped, from which on tracks are triangulated in every view and from fewer
of them: the camera may leave what is known within a few."""
PREDICTED_LENGTHS, LIVE_PREDICTED_LENGTHS = 4, 16
"""Lengths of the newest view over which its motion is taken to go on, for the templates of tracks."""
PREDICTION_VIEWS = 40
"""Newest views in which posed ones are sought to predict the next pose."""
LOCAL_BA_VIEWS, LOCAL_BA_FIXED, LOCAL_BA_OLDER = 10, 4, 4
"""Views of a local bundle adjustment: the newest have free poses, those just before and older ones fix the gauge."""
LOCAL_BA_REACH = 40
"""Newest views among which all of these are."""
LOCAL_BA_ITERATIONS, LOCAL_BA_TOLERANCE = 3, 1e-3
"""Most iterations of a local bundle adjustment, and the relative gain of an iteration below which it ends."""


@dataclass
class PoseTracker:
    """Tracks view after view against a map that is initialised."""

    map: SparseMap
    status: TrackingState
    tracks: Tracks
    relocaliser: Relocaliser
    adjuster: PathAdjuster
    live: bool = False
    """The camera does not wait: its views may lie far apart."""

    def track(self, picture: Picture) -> None:
        """Estimate the pose of the newest view, then extend and adjust the map."""
        view = self.map.views[-1]
        fit = fit_pose(self.map, view, predict(self._known(PREDICTION_VIEWS), view.time))
        if (why := fit.lost_reason()) is not None:
            found = self.relocaliser.find(view, picture)
            if found is None:
                if fit.chi2 > LOST_CHI2:
                    self.tracks.forget()  # the tracks follow motion blur and have left their points
                self.status.set(view.time, State.LOST, f"{why}: {_lost_hint(view)}")
                return
            fit = found
            self.tracks.resume(view.id, view.ids, view.pixels)
            self.status.set(view.time, State.RELOC, f"found again by {fit.points} points of earlier views")
        fit.store(view)
        if self.adjuster.newest_keyframe is view:
            self._recover_tracks(view, picture)
        self._extend_map(view, fit)

    def template_warps(self, time: float) -> NDArray[np.float32]:
        """See `template_warps`, for a view at `time` frames on a long path, or through a lens that bends.

        None elsewhere, where they do harm, and where the pose cannot be predicted: while lost, and after a gap.
        """
        newest = self.map.views[-1] if self.map.views else None
        wanted = self.adjuster.newest_keyframe is not None or self.map.intrinsics.distortion is not None
        if not wanted or newest is None or newest.pose is None:
            return NO_WARPS
        lengths = LIVE_PREDICTED_LENGTHS if self.live else PREDICTED_LENGTHS
        if time - newest.time > lengths * newest.length:
            return NO_WARPS
        return template_warps(self.map, self.tracks, predict(self._known(PREDICTION_VIEWS), time))

    def triangulate_recent(self) -> None:
        """Triangulate tracks from the newest views."""
        recent = self.map.views[-RECENT_VIEWS:]
        older = [view for view in self.adjuster.reference_views if view.id < recent[0].id]
        least = TRIANGULATION_MIN_FAR_VIEWS if self._far else TRIANGULATION_MIN_VIEWS
        self.map.triangulate(older + recent, least, LIVE_STEPS if self.live else 0)

    @property
    def _far(self) -> bool:
        """The camera is live, frames were skipped, and the newest view lies far from the one before."""
        return self.live and self.tracks.far and self.map.views[-1].motion_px > FAR_PX

    def _known(self, newest: int) -> list[TrackedView]:
        """The last two views with a pose, or one: if possible of the `newest` views."""
        return ([v for v in self.map.views[-newest:] if v.pose is not None] or self.map.posed())[-2:]

    def _recover_tracks(self, view: TrackedView, picture: Picture) -> None:
        """Resume tracks that ended, or left the image, before the newest view: they tie more keyframes together."""
        ids, pixels = self.relocaliser.recover(view, picture)
        self.tracks.resume(view.id, ids, pixels)
        view.ids, view.pixels = np.concatenate([view.ids, ids]), np.concatenate([view.pixels, pixels])

    def _extend_map(self, view: TrackedView, fit: PnPResult) -> None:
        """Triangulate and adjust after the newest view got its pose, then update the state."""
        count = len(self.map.views)
        if count % TRIANGULATE_EVERY == 0 or self._far:
            self.triangulate_recent()
        # New points are triangulated from few views: a large residual counts only after a local adjustment.
        off = fit.chi2 > WORST_CHI2 and fit.inliers > WORST_INLIERS
        if self.adjuster.due:
            self.adjuster.adjust(final=False)
        elif count % LOCAL_BA_EVERY == 0 or off:
            self._local_bundle_adjustment()
        if view.pose is None:
            self.status.set(view.time, State.LOST, f"the path as a whole contradicts this view: {_lost_hint(view)}")
            return
        if off:
            fit = fit_pose(self.map, view, view.pose)
            fit.store(view)
        self.status.assess(view.time, fit.degraded_reason(len(view.ids)))

    def _local_bundle_adjustment(self) -> None:
        """Adjust the newest poses and their points, see `LOCAL_BA_VIEWS`."""
        posed = [view for view in self.map.views[-LOCAL_BA_REACH:] if view.pose is not None]
        near, far = posed[-LOCAL_BA_VIEWS - LOCAL_BA_FIXED :], posed[: -LOCAL_BA_VIEWS - LOCAL_BA_FIXED]
        reference = [view for view in self.adjuster.reference_views if view.pose is not None and view.id < near[0].id]
        views = (reference or far[:: -(-len(far) // LOCAL_BA_OLDER) or 1]) + near
        made = self.map.bundle(views) if len(views) > LOCAL_BA_FIXED + 2 else None
        if made is None:
            return
        frozen = np.ones(len(views), bool)
        frozen[max(LOCAL_BA_FIXED, len(reference), len(views) - LOCAL_BA_VIEWS) :] = False
        made.bundle.optimise(LOCAL_BA_ITERATIONS, SCALE_PX, frozen, LOCAL_BA_TOLERANCE)
        self.map.apply(made)


def predict(last: list[TrackedView], time: float) -> Pose:
    """The pose at `time` from the last one or two views with a pose at constant velocity."""
    b = last[-1].pose
    assert b is not None
    if len(last) == 1:
        return b
    a = last[-2].pose
    assert a is not None
    u = (time - last[-1].time) / max(last[-1].time - last[-2].time, 1e-9)
    rotation = b.rotation @ exp_so3(u * log_so3(a.rotation.T @ b.rotation))
    return Pose(rotation, b.centre + u * (b.centre - a.centre))


def _lost_hint(view: TrackedView) -> str:
    """Likely cause of lost tracking, for users."""
    if len(view.ids) < 2 * MIN_POINTS:
        return "too few features in view (blank, dark or blurred)"
    return "the camera moved too fast, or something hides the known part of the scene"
