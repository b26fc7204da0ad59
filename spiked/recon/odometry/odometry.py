"""Sparse visual odometry: views in order, poses, points and a spline of the path out.

It needs no map of Gaussians: a trajectory exists within a second or two, and mapping then refines it.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spiked.evaluate import Similarity
from spiked.pose import Array
from spiked.recon.frontend.feature_tracks import Picture
from spiked.recon.frontend.photon_counts import PhotonCounts
from spiked.recon.frontend.spike_intervals import SpikeIntervals
from spiked.recon.odometry.keyframe_pictures import KeyframePictures, PictureBuilder
from spiked.recon.odometry.loop_closure import LoopClosure
from spiked.recon.odometry.map_odometry import MapOdometry
from spiked.recon.odometry.pnp import PnPResult, fit_pose
from spiked.recon.odometry.second_map import SECOND_MAP_VIEWS, Meeting, join, unposed
from spiked.recon.odometry.self_calibration import Focal
from spiked.recon.odometry.sparse_map import TrackedView
from spiked.recon.odometry.tracking_state import State
from spiked.sensor import Intrinsics


class Odometry(MapOdometry):
    """Begins a second map where the camera is lost for long, and joins both once a place is seen again.

    Feed views in order with `add`, then call `end`; the path is `spline`, or `waypoints` where it is `sparse`.
    """

    def __init__(
        self,
        intrinsics: Intrinsics,
        seed: int = 0,
        focal: Focal | None = None,
        live: bool = False,
        pictures: KeyframePictures | None = None,
    ) -> None:
        """See `MapOdometry`."""
        super().__init__(intrinsics, seed, focal, live, pictures)
        self._seed = seed
        self._lost_views = 0
        """Lost views in a row."""
        self._second: Odometry | None = None
        """A map of what a lost camera sees; it numbers views and tracks as this one does."""
        self._meeting: Meeting | None = None
        self._second_begin = 0
        """First view that the second map may have."""
        self.remark: str | None = None
        """What of the recording the finished path leaves out, for users."""

    def fixed_arrays(self) -> Iterator[NDArray[Any]]:
        """See `MapOdometry.fixed_arrays`; with those of the second map."""
        yield from super().fixed_arrays()
        if self._second is not None:
            yield from self._second.fixed_arrays()

    def build_images_with(self, builder: PictureBuilder) -> None:
        """Set what builds images of keyframes anew."""
        super().build_images_with(builder)
        if self._second is not None:
            self._second.build_images_with(builder)

    @property
    def long(self) -> bool:
        """The path is long: keyframes are adjusted."""
        return super().long or (self._second is not None and self._second.long)

    def skip(self) -> None:
        """Frames are skipped before the next view; see `sparse`."""
        super().skip()
        if self._second is not None:
            self._second.skip()

    def add(
        self,
        time: float,
        length: int,
        picture: Picture,
        known: tuple[Array, Array] | None = None,
        intervals: SpikeIntervals | PhotonCounts | None = None,
        after_gap: bool = False,
    ) -> TrackedView:
        """See `MapOdometry.add`; of a lost camera, in the second map."""
        if self._second is not None:
            return self._add_to_second(self._second, time, length, picture, intervals, after_gap)
        view = super().add(time, length, picture, known, intervals, after_gap)
        self._lost_views = self._lost_views + 1 if self.state is State.LOST else 0
        if self._lost_views == SECOND_MAP_VIEWS:
            self._begin_second()
        return view

    def _begin_second(self) -> None:
        """Begin a second map with the next view."""
        second = Odometry(self.intrinsics, self._seed, live=self._live, pictures=self.keyframe_images.like())
        second._map.lens_known = True
        second._map.views = unposed(self.views)
        second._map.reserve(len(self.points))
        second._initialiser.begin_at(len(self.views))
        second._tracks.next_id, second._tracks.far = self._tracks.next_id, self._tracks.far
        loops = self._loop_search() if self._keyframes is None else self._keyframes.loops
        self._second, self._second_begin = second, len(self.views)
        self._meeting = Meeting(self._map, loops, self.keyframe_images)

    def _add_to_second(
        self,
        second: "Odometry",
        time: float,
        length: int,
        picture: Picture,
        intervals: SpikeIntervals | PhotonCounts | None,
        after_gap: bool,
    ) -> TrackedView:
        """Let the second map track a view, and search it for a place of this one."""
        assert self._meeting is not None
        own = second.add(time, length, picture, intervals=intervals, after_gap=after_gap)
        view = replace(own, pose=None, state=State.LOST, inliers=0.0, chi2=None, sigma_px=None)
        self.views.append(view)
        self._map.reserve(len(second.points))
        self._status.set(time, State.LOST, _second_map_reason(second))
        if (found := self._meeting.search(view, picture)) is not None:
            if own.pose is None:
                self._resume(second, view, found.ids, found.pixels, fit_pose(self._map, _seen(found), found.pose))
            elif (by := self._meeting.agreed(found, second.map)) is not None:
                self._join(second, by)
        elif second.state is State.BOOT and (fit := self._relocaliser.find(view, picture)) is not None:
            self._resume(second, view, view.ids, view.pixels, fit)
        view.state = self.state
        return view

    def _resume(
        self, second: "Odometry", view: TrackedView, ids: NDArray[np.int64], pixels: Array, fit: PnPResult
    ) -> None:
        """Go on in this map with a view that was recognised, and drop the second one, which did not know its pose."""
        view.ids, view.pixels = ids, pixels
        fit.store(view)
        self._take_tracks(second)
        self._tracks.resume(view.id, ids, pixels)
        self._status.set(view.time, State.RELOC, f"found again by {len(ids)} points of earlier views")

    def _join(self, second: "Odometry", by: Similarity) -> None:
        """Take the second map into this one, and go on with its tracks."""
        assert self._meeting is not None
        meeting, begin, count = self._meeting, self._second_begin, len(second.map.posed())
        if second._keyframes is not None:
            second._keyframes.settle()
        if self._keyframes is not None:
            self._keyframes.settle()
        join(self._map, second.map, begin, by)
        self.keyframe_images.take(second.keyframe_images)
        self._take_tracks(second)
        self._adjust_keyframes(meeting.loops)
        assert self._keyframes is not None
        closures = [replace(one, before=one.later.pose or one.before) for one in meeting.closures]
        self._keyframes.join(self.views[begin:], closures)
        self._tracks.resume(self.views[-1].id, closures[-1].ids, closures[-1].pixels)
        time = self.views[-1].time
        self._status.set(time, State.RELOC, f"a known place is seen again: {count} views of a second map are joined")

    def _take_tracks(self, second: "Odometry") -> None:
        """Go on with the tracks of the second map, which ends."""
        while second._second is not None:
            second = second._second
        self._tracks = self._tracker.tracks = second._tracks
        self._timestamps = second._timestamps
        self._second = self._meeting = None
        self._lost_views = 0

    def _end_second_map(self, stop: Callable[[], bool], save: Callable[[], None], preliminary: bool) -> None:
        if self._second is not None:
            self._end_second(self._second, stop, save, preliminary)

    def _end_second(
        self, second: "Odometry", stop: Callable[[], bool], save: Callable[[], None], preliminary: bool
    ) -> None:
        """No known place was seen again: the path is that of the map that spans more time."""
        second.end(stop, save, preliminary)
        views = [view for view in second.views[self._second_begin :] if view.pose is not None]
        ours = self._map.posed()
        self._second = self._meeting = None
        if not views:
            return
        if views[-1].time - views[0].time <= ours[-1].time - ours[0].time:
            self.remark = _left_out(views)
            return
        for view in ours:
            view.pose = None
        self._map.points[:] = np.nan
        join(self._map, second.map, self._second_begin, Similarity(1.0, np.eye(3), np.zeros(3)))
        self.keyframe_images.take(second.keyframe_images)
        self._adjuster, self._keyframes = second._adjuster, second._keyframes
        self._status.set(self.views[-1].time, second.state, second.reason)
        self.remark = _left_out(ours)


def _second_map_reason(second: Odometry) -> str:
    """Why a camera whose pictures are tracked in a second map is lost."""
    if second.state is State.BOOT:
        return f"no known place is seen; for a second map: {second.reason}"
    if second.state is State.LOST:
        return f"no known place is seen, and a second map lost the camera, too: {second.reason}"
    count = len(second.map.posed())
    return f"{count} views have a pose in a second map: it is joined once a place of the first map is seen again"


def _left_out(views: list[TrackedView]) -> str:
    return (
        f"frames {views[0].time:.0f} to {views[-1].time:.0f} belong to a second map, which no common place joins with "
        "this one: they have no pose"
    )


def _seen(found: LoopClosure) -> TrackedView:
    """The view with the points of the place alone."""
    return replace(found.later, ids=found.ids, pixels=found.pixels)
