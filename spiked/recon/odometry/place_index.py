"""Places of a path: its kept views by where they were taken and by what they show."""

from bisect import bisect_left
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from spiked.pose import Array
from spiked.recon.frontend.feature_tracks import Picture
from spiked.recon.frontend.features import Features, find_features, match
from spiked.recon.frontend.retrieval import Retrieval
from spiked.recon.odometry.pnp import draw_pose
from spiked.recon.odometry.sparse_map import Pose, SparseMap, TrackedView
from spiked.sensor import Intrinsics

PLACE_PX = 20.0
"""Image motion from one view whose features are kept to the next: features are found again over 40 px and more."""
FEATURES = 200
"""Features of a place, at most: finding them takes most of the time."""
HALVED_PX = 200
"""Shorter side of images from which on features are found in the halved image: a quarter of the time."""
TRACK_REACH_PX, NEAREST_TRACKS = 12.0, 3
"""A feature has the depth of the nearest of so many tracks that has a point, and lies no farther away."""
RETRIEVED = 4
"""Places, retrieved by features, that are compared with a view."""
LEAST_MATCHES = 12
"""Features of a place matched in a view, from which a pose is drawn."""
RELEARN_RATIO = 1.5
"""Growth of the number of places after which the principal components of their descriptors are computed again."""


@dataclass(frozen=True)
class Place:
    """A kept view with its features."""

    view: TrackedView
    features: Features
    tracks: NDArray[np.int64]
    """[n, NEAREST_TRACKS] ids of the tracks near each feature, the nearest first; -1 where there is none."""

    def points(self, sparse_map: SparseMap) -> Array:
        """Points [n, 3] of the features at the depth of the nearest track that has a point; NaN without one."""
        pose = self.view.pose
        if pose is None:
            return np.full((len(self.features), 3), np.nan)
        depths = (sparse_map.points[self.tracks] - pose.centre) @ pose.rotation[:, 2]
        depths[(self.tracks < 0) | ~(depths > 0)] = np.nan
        first = np.isfinite(depths).argmax(1)
        depth = depths[np.arange(len(depths)), first]
        return np.asarray(
            pose.centre + depth[:, None] * sparse_map.intrinsics.unproject(self.features.pixels) @ pose.rotation.T
        )


@dataclass
class PlaceIndex:
    """Kept views in order of time, those `PLACE_PX` apart with features."""

    map: SparseMap
    numbers: list[int] = field(default_factory=list)
    """Ids of the views, ascending."""
    places: list[Place] = field(default_factory=list)
    _retrieval: Retrieval | None = None
    _learned: int = 0
    """Number of places from which the retrieval has its principal components."""

    def fixed_arrays(self) -> Iterator[NDArray[Any]]:
        """Arrays that never change."""
        for place in self.places:
            yield from (place.features.pixels, place.features.descriptors, place.tracks)
        if self._retrieval is not None:
            yield from self._retrieval.fixed_arrays()

    def add(self, view: TrackedView) -> None:
        """Add a view, newer than the others, that was taken elsewhere."""
        self.numbers.append(view.id)

    def add_features(self, view: TrackedView, features: Features) -> None:
        """Let a view be retrieved by its features."""
        if len(features) < LEAST_MATCHES or len(view.ids) < NEAREST_TRACKS:
            return
        _, near = cKDTree(view.pixels).query(features.pixels, NEAREST_TRACKS, distance_upper_bound=TRACK_REACH_PX)
        tracks = np.append(view.ids, -1)[near]  # those out of reach have the number of tracks as index
        self.places.append(Place(view, features, tracks))
        if self._retrieval is not None and len(self.places) < RELEARN_RATIO * self._learned:
            self._retrieval.add(features)
        else:
            self._retrieval = Retrieval([place.features for place in self.places])
            self._learned = len(self.places)

    def near(self, pose: Pose, depth: float, before_px: float, count: int) -> list[TrackedView]:
        """The views before so much image motion that were taken nearest to a pose, the nearest first.

        `depth` is what a shift of the camera is compared with.
        """
        last = bisect_left(self.numbers, before_px, key=self.map.travelled_px)
        views = [view for view in map(self.map.views.__getitem__, self.numbers[:last]) if view.pose is not None]
        if not views:
            return []
        rotations, centres = zip(*(view.pose for view in views if view.pose is not None), strict=True)
        shifts = shifts_px(self.map.intrinsics, np.stack(rotations), np.stack(centres), pose, depth)
        return [views[row] for row in np.argsort(shifts, kind="stable")[:count]]

    def drawn_poses(self, features: Features, before_px: float) -> list[tuple[Pose, int]]:
        """Poses from which these features may have been seen, by the places before so much image motion: each with the
        number of features that agree, the most first."""
        if self._retrieval is None:
            return []
        few = len(self.places) <= RETRIEVED  # all of them are compared: votes tell places apart
        votes = np.ones(len(self.places)) if few else self._retrieval.votes(features)
        old = np.array([self.map.travelled_px(place.view.id) < before_px for place in self.places])
        votes[~old] = 0
        drawn = []
        for row in np.argsort(-votes, kind="stable")[:RETRIEVED]:
            if votes[row] <= 0:
                break
            place = self.places[row]
            rows, columns = match(features, place.features)
            points = place.points(self.map)[columns]
            known = np.isfinite(points[:, 0])
            if known.sum() < LEAST_MATCHES:
                continue
            pixels = np.ascontiguousarray(features.pixels[rows][known])
            if (found := draw_pose(np.ascontiguousarray(points[known]), pixels, self.map.intrinsics)) is not None:
                drawn.append(found)
        return sorted(drawn, key=lambda one: -one[1])


def place_features(picture: Picture) -> Features:
    """Features of an image [H, W], by which its place is recognised."""
    if min(picture.shape) < HALVED_PX:
        return find_features(picture, FEATURES)
    small = cv2.resize(picture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    found = find_features(np.asarray(small, np.uint8), FEATURES)
    return Features(2 * found.pixels, found.descriptors)


def shifts_px(intrinsics: Intrinsics, rotations: Array, centres: Array, pose: Pose, depth: float) -> Array:
    """How far the image moves from poses [..., 3, 3], [..., 3] to another, at most, for points at `depth`."""
    cosine = (np.einsum("...ij,ij->...", rotations, pose.rotation) - 1) / 2
    turn = np.arccos(np.clip(cosine, -1, 1))
    return np.asarray(intrinsics.fx * (turn + np.linalg.norm(centres - pose.centre, axis=-1) / depth))
