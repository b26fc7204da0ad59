"""Odometry in one map: views in order, poses, points and a spline of the path out."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spiked.pose import Array
from spiked.recon.frontend.feature_tracks import Picture, Tracks
from spiked.recon.frontend.photon_counts import PhotonCounts
from spiked.recon.frontend.spike_intervals import SpikeIntervals
from spiked.recon.frontend.track_timestamps import TrackTimestamps
from spiked.recon.odometry.assessment import assess
from spiked.recon.odometry.global_adjuster import GlobalAdjuster
from spiked.recon.odometry.initialiser import Initialiser
from spiked.recon.odometry.keyframe_adjuster import LEAST_MOTION_PX, MOST_MOTION_PX, KeyframeAdjuster
from spiked.recon.odometry.keyframe_pictures import KeyframePictures, PictureBuilder
from spiked.recon.odometry.long_paths import LONG_FRAMES, LONG_VIEWS
from spiked.recon.odometry.loop_closure import EVERY_PX, LIVE_EVERY_PX, LoopSearch
from spiked.recon.odometry.path_adjuster import PathAdjuster
from spiked.recon.odometry.pose_tracker import LOCAL_BA_EVERY, PoseTracker
from spiked.recon.odometry.relocaliser import LIVE_OLDER_KEYFRAMES, Relocaliser
from spiked.recon.odometry.self_calibration import EstimatedLens, Focal
from spiked.recon.odometry.sparse_map import Pose, SparseMap, TrackedView
from spiked.recon.odometry.tracking_state import State, TrackingState
from spiked.sensor import Intrinsics
from spiked.spline import Spline, Waypoints

MIN_GIVEN_POINTS = 10
"""Points in front of the camera that given poses have to explain."""


class MapOdometry:
    """Feed views in order with `add`, then call `end`; the path is `spline`, or `waypoints` where it is `sparse`.

    Composed of the parts of one map: `Initialiser` until there is one, then `PoseTracker` with its `Relocaliser`,
    and `GlobalAdjuster`, which owns the spline; on long paths `KeyframeAdjuster` takes its place.
    """

    def __init__(
        self,
        intrinsics: Intrinsics,
        seed: int = 0,
        focal: Focal | None = None,
        live: bool = False,
        pictures: KeyframePictures | None = None,
    ) -> None:
        """focal: set where the focal length is to be estimated; live: reasons advise how to move the camera now,
        and views do not wait for other threads; pictures: where images of keyframes are held."""
        self._live = live
        self._map = SparseMap(intrinsics, focal, lens_known=intrinsics.distortion is not None)
        self._status = TrackingState()
        self._tracks = Tracks()
        self._timestamps = TrackTimestamps()
        self._initialiser = Initialiser(self._map, self._status, seed, live)
        self._adjuster: PathAdjuster = GlobalAdjuster(self._map)
        self._keyframes: KeyframeAdjuster | None = None
        """The adjuster of a long path."""
        self._relocaliser = Relocaliser(
            self._map,
            KeyframePictures() if pictures is None else pictures,
            older_tried=LIVE_OLDER_KEYFRAMES if live else None,
        )
        self._tracker = PoseTracker(self._map, self._status, self._tracks, self._relocaliser, self._adjuster, live)
        self.path_error: float | None = None
        """Predicted error of the finished path relative to its RMS radius; None before the end."""

    @property
    def map(self) -> SparseMap:
        """Views and points."""
        return self._map

    @property
    def keyframe_images(self) -> KeyframePictures:
        """Images of the keyframes by view id."""
        return self._relocaliser.keyframes

    @property
    def closures(self) -> list[tuple[float, float]]:
        """Closed loops: times in frames of an earlier view and of a later one that sees the same place again."""
        return self._adjuster.closures

    @property
    def views(self) -> list[TrackedView]:
        """All views by id; poses change with every adjustment."""
        return self._map.views

    @property
    def points(self) -> Array:
        """Position [tracks, 3] of every track by id, NaN where unknown."""
        return self._map.points

    @property
    def intrinsics(self) -> Intrinsics:
        """Given or, so far, estimated."""
        return self._map.intrinsics

    @property
    def focal(self) -> Focal | None:
        """Estimate of the focal length; None if it was given."""
        return self._map.focal

    @property
    def lens(self) -> EstimatedLens | None:
        """Estimate of the distortion; None if it was given, or if there is none to be seen."""
        return self._map.lens

    @property
    def state(self) -> State:
        """Of the newest view, after `end` of the last views."""
        return self._status.state

    @property
    def reason(self) -> str:
        """Of the state, for users."""
        return self._status.reason

    @property
    def changes(self) -> list[tuple[float, State, str]]:
        """(time in frames, state, reason) of each change of state."""
        return self._status.changes

    @property
    def spline(self) -> Spline | None:
        """The path so far in frames; None before the bootstrap and where the path is `sparse`."""
        return self._adjuster.spline

    @property
    def sparse(self) -> bool:
        """Views are too far apart for a spline, or the path is long: it is interpolated, see `waypoints`."""
        return self._adjuster.interpolated

    @property
    def end_left(self) -> float:
        """Share of the work of `end` that is left."""
        return self._adjuster.end_left

    def waypoints(self) -> Waypoints | None:
        """The path interpolated between views with a pose; None before the bootstrap.

        Those of a live camera lie further apart than a hand that trembles moves evenly.
        """
        return self._map.waypoints(smooth=self._live)

    def information(self) -> Array | None:
        """Inverse covariance [6 knots, 6 knots] of `spline`, see `GlobalAdjuster.information`."""
        return self._adjuster.information()

    def fixed_arrays(self) -> Iterator[NDArray[Any]]:
        """Arrays that are replaced and never changed in place: a checkpoint writes each of them once."""
        for view in self.views:
            yield view.ids
            yield view.pixels
        yield from self.keyframe_images.held()
        if self._keyframes is not None:
            yield from self._keyframes.loops.index.fixed_arrays()

    def build_images_with(self, builder: PictureBuilder) -> None:
        """Set what builds images of keyframes anew."""
        self.keyframe_images.builder = builder

    @property
    def long(self) -> bool:
        """The path is long: keyframes are adjusted."""
        return self._keyframes is not None

    def skip(self) -> None:
        """Frames are skipped before the next view; see `sparse`."""
        self._adjuster.interpolated = self._tracks.far = True

    def add(
        self,
        time: float,
        length: int,
        picture: Picture,
        known: tuple[Array, Array] | None = None,
        intervals: SpikeIntervals | PhotonCounts | None = None,
        after_gap: bool = False,
    ) -> TrackedView:
        """Track one view of `length` frames around `time` and estimate its pose.

        known: its pose, if given; intervals: time of each pixel's charge; after_gap: frames are missing before it.
        Returns the new element of `views`.
        """
        view = self._track(time, length, picture, intervals, after_gap)
        if known is not None:
            view.pose = Pose(*known)
            if len(self.views) % LOCAL_BA_EVERY == 0:
                self._tracker.triangulate_recent()
            self._status.set(time, State.TRACK, "poses are given")
        elif self.state is not State.BOOT:
            self._adjust_keyframes_if_long()
            self._tracker.track(picture)
        elif self._initialiser.attempt():
            self._adjuster.adjust()
        if self._relocaliser.remember(view, picture):
            self._close_loops(view)
        view.state = self.state
        return view

    def _close_loops(self, view: TrackedView) -> None:
        """On a long path, search the newest view for places seen before; their points become its tracks."""
        if self._keyframes is None:
            return
        for closure in self._keyframes.close_loops(view):
            if closure.later is view:
                self._tracks.resume(view.id, closure.ids, closure.pixels)

    def _adjust_keyframes_if_long(self) -> None:
        """From `LONG_FRAMES` or `LONG_VIEWS` on, adjust keyframes in a window instead of the whole path."""
        if self._keyframes is not None:
            return
        posed = self._map.posed()
        if posed and (len(posed) >= LONG_VIEWS or posed[-1].time - posed[0].time >= LONG_FRAMES):
            self._adjust_keyframes(self._loop_search())

    def _loop_search(self) -> LoopSearch:
        return LoopSearch.of(self._map, self.keyframe_images, LIVE_EVERY_PX if self._live else EVERY_PX)

    def _adjust_keyframes(self, loops: LoopSearch) -> None:
        """Adjust keyframes from now on, if that is not done yet."""
        if self._keyframes is None:
            self._relocaliser.least_motion_px = LEAST_MOTION_PX
            if self._live:
                self._relocaliser.most_motion_px = MOST_MOTION_PX
            self._keyframes = KeyframeAdjuster(self._map, self.keyframe_images, loops, live=self._live)
            self._adjuster = self._tracker.adjuster = self._keyframes

    def _track(
        self,
        time: float,
        length: int,
        picture: Picture,
        intervals: SpikeIntervals | PhotonCounts | None,
        after_gap: bool,
    ) -> TrackedView:
        """Append a view with its tracks, moved to its time."""
        number = len(self.views)
        motion_px = self._tracks.add(number, picture, after_gap, self._tracker.template_warps(time))
        ids, at = self._tracks.ids.copy(), self._tracks.at.copy()
        late = np.zeros(len(ids)) if intervals is None else intervals.delays(picture, at)
        pixels, sigma_px = self._timestamps.align(time, ids, at, late)
        view = TrackedView(number, time, length, ids, pixels, motion_px, self.state, timing_sigma_px=sigma_px)
        self.views.append(view)
        self._map.reserve(self._tracks.next_id)
        return view

    def end(
        self,
        stop: Callable[[], bool] = lambda: False,
        save: Callable[[], None] = lambda: None,
        preliminary: bool = False,
    ) -> None:
        """After the last view: a last bootstrap attempt if needed, then the final global adjustment.

        The arguments are those of `PathAdjuster.finish`.
        """
        if self.state is State.BOOT and self._initialiser.last_attempt():
            self._adjust_keyframes_if_long()
            self._adjuster.adjust()
        self._end_second_map(stop, save, preliminary)
        self._adjuster.finish(stop, save, preliminary)
        self.path_error = self._adjuster.path_error()
        assess(self._map, self._status, self.path_error, self._initialiser.rough)

    def _end_second_map(self, stop: Callable[[], bool], save: Callable[[], None], preliminary: bool) -> None:
        """Where another map was begun, decide which one the path is of."""

    def end_with_path(self, spline: Spline, middle: float) -> float | None:
        """After the last view with a given pose: take the given path; its median depth at `middle` (frames) becomes 1.

        Returns that depth in the unit of the given path. None if fewer than `MIN_GIVEN_POINTS` were triangulated:
        there is no path then, and `reason` says so.
        """
        self._map.triangulate(self.views)
        points = self.points[np.isfinite(self.points[:, 0])]
        rotations, centres = spline.poses([middle])
        depth = (points - centres[0]) @ rotations[0][:, 2]
        if (depth > 0).sum() < MIN_GIVEN_POINTS:
            self._status.explain("the given poses do not explain the tracks: no point could be triangulated")
            return None
        unit = float(np.median(depth[depth > 0]))
        self._map.rescale(unit)
        self._adjuster.spline = replace(spline, centres=spline.centres / unit)
        return unit
