"""A second map, made while the camera is lost, and how it is joined with the first once a known place is seen again.

Both maps number views and tracks alike, so that joining them is one similarity.
"""

from collections import ChainMap
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial import cKDTree

from spiked.evaluate import Similarity
from spiked.pose import Array
from spiked.recon.frontend.feature_tracks import Picture
from spiked.recon.odometry.loop_closure import AGREEING_PX, AGREEING_VIEWS, LoopClosure, LoopSearch, shift_px
from spiked.recon.odometry.place_index import TRACK_REACH_PX
from spiked.recon.odometry.sparse_map import Pose, SparseMap, TrackedView
from spiked.sensor import LEAST_DEPTH

SECOND_MAP_VIEWS = 16
"""Lost views in a row after which a second map is begun: shorter losses end with the points of the newest keyframes."""
SEARCH_PX, SEARCH_VIEWS = 10.0, 8
"""Image motion, or views, from one search for a known place to the next."""
LEAST_PAIRS = 15
"""Points of the first map next to points of the second, in one view, by whose depths the scales are compared."""
MOST_SCALE_RATIO = 1.15
"""Largest ratio of the scales by which two views bring the maps together."""


@dataclass(frozen=True)
class Sighting:
    """A view of the second map in which a place of the first one was recognised."""

    closure: LoopClosure
    own: Pose
    """Of the view in the second map."""
    log_scale: float
    """Logarithm of the length in the first map of a unit of the second one, by the depths of points."""

    def similarity(self, log_scale: float) -> Similarity:
        """From the second map to the first, at a scale."""
        scale, found = float(np.exp(log_scale)), self.closure.pose
        rotation = found.rotation @ self.own.rotation.T
        return Similarity(scale, rotation, found.centre - scale * rotation @ self.own.centre)


@dataclass
class Meeting:
    """Searches the places of the first map in views of a lost camera, and believes them when several views agree."""

    map: SparseMap
    loops: LoopSearch
    pictures: Mapping[int, Picture]
    """Images of the kept views of the first map."""
    _moved_px: float = np.inf
    _views: int = 0
    """Image motion and views since the last search."""
    _run: list[Sighting] = field(default_factory=list)

    def search(self, view: TrackedView, picture: Picture) -> LoopClosure | None:
        """A place of the first map in the newest view, if it is time to search one."""
        self._moved_px += view.moved_px
        self._views += 1
        if self._moved_px < SEARCH_PX and self._views < SEARCH_VIEWS:
            return None
        self._moved_px, self._views = 0.0, 0
        return self.loops.recognise(view, ChainMap({view.id: picture}, self.pictures))  # type: ignore[arg-type]

    def agreed(self, found: LoopClosure, second: SparseMap) -> Similarity | None:
        """The similarity from the second map to the first, once `AGREEING_VIEWS` views in a row agree in it."""
        own = second.views[found.later.id]
        log_scale = None if own.pose is None else _log_scale(self.map, found, own, second)
        if own.pose is None or log_scale is None:
            return None
        new = Sighting(found, own.pose, log_scale)
        if self._run and not self._agree(new):
            self._run = []
        self._run.append(new)
        if len(self._run) < AGREEING_VIEWS:
            return None
        return new.similarity(self._scale)

    @property
    def closures(self) -> list[LoopClosure]:
        """Those of the views that agree."""
        return [one.closure for one in self._run]

    @property
    def _scale(self) -> float:
        return float(np.median([one.log_scale for one in self._run]))

    def _agree(self, new: Sighting) -> bool:
        if abs(new.log_scale - self._scale) > np.log(MOST_SCALE_RATIO):
            return False
        expected = moved(self._run[-1].similarity(self._scale), new.own)
        found = new.closure
        return shift_px(self.map.intrinsics, expected, found.pose, found.depth) < AGREEING_PX


def moved(by: Similarity, pose: Pose) -> Pose:
    """A pose of the second map in the first one."""
    return Pose(*by.poses(pose.rotation, pose.centre))


def join(first: SparseMap, second: SparseMap, begin: int, by: Similarity) -> None:
    """Take the poses, tracks and points of the second map, whose views begin with number `begin`, into the first."""
    for number in range(begin, len(first.views)):
        view, own = first.views[number], second.views[number]
        view.ids, view.pixels = own.ids, own.pixels
        if own.pose is not None:
            view.pose, view.state = moved(by, own.pose), own.state
            view.inliers, view.chi2, view.sigma_px = own.inliers, own.chi2, own.sigma_px
    first.reserve(len(second.points))
    known = np.flatnonzero(np.isfinite(second.points[:, 0]))
    first.points[known] = by.points(second.points[known])


def unposed(views: list[TrackedView]) -> list[TrackedView]:
    """Copies of views without poses: the past of a second map."""
    return [replace(view, pose=None) for view in views]


def _log_scale(first: SparseMap, found: LoopClosure, own: TrackedView, second: SparseMap) -> float | None:
    """See `Sighting.log_scale`; None with too few pairs of points that lie next to each other in the view."""
    ids, pixels = second.known_tracks(own)
    if len(ids) < LEAST_PAIRS or own.pose is None:
        return None
    distance, near = cKDTree(pixels).query(found.pixels)
    depths = _depths(first.points[found.ids], found.pose), _depths(second.points[ids[near]], own.pose)
    good = (distance < TRACK_REACH_PX) & (depths[0] > LEAST_DEPTH) & (depths[1] > LEAST_DEPTH)
    return float(np.median(np.log(depths[0][good] / depths[1][good]))) if good.sum() >= LEAST_PAIRS else None


def _depths(points: Array, pose: Pose) -> Array:
    return np.asarray((points - pose.centre) @ pose.rotation[:, 2])
