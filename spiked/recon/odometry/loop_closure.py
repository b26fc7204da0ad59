"""Loop closure: views that see points of much earlier views again, and the correction of the path between them."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from spiked.pose import Array, exp_so3, log_so3, mean_rotation
from spiked.recon.frontend.feature_tracks import Picture, flow
from spiked.recon.frontend.features import Features
from spiked.recon.odometry.initialisation import INLIER_PX
from spiked.recon.odometry.place_index import PLACE_PX, PlaceIndex, place_features, shifts_px
from spiked.recon.odometry.pnp import fit_pose
from spiked.recon.odometry.sparse_map import Pose, SparseMap, TrackedView
from spiked.recon.statistics import median
from spiked.sensor import LEAST_DEPTH, Intrinsics

LEAST_APART_PX = 300.0
"""Image motion between two views of a loop, at least: nearer ones share tracks (decision 15)."""
EVERY_PX, LIVE_EVERY_PX = 10.0, 40.0
"""Image motion from one view in which loops are searched to the next: a camera that stands still adds none (decision
15). A live camera does not wait for a search of 10 to 40 ms."""
LOOP_SPAN_PX = 500.0
"""Image motion over which the closures of one loop may lie: their drift is taken as one."""
MOST_SHARED = 15
"""Tracks that two views of a loop share, at most (decision 15)."""
COMPARED = 16
"""Nearest earlier views of which the one is taken that most points are seen of again."""
LEAST_INSIDE = 0.4
"""Share of the points of the earlier view that project into the later one."""
LEAST_MATCHES = 30
"""Points that are found again, and agree with one pose (decision 15)."""
LEAST_AGREEING = 0.7
"""Share of the points found that agree with one pose (decision 15)."""
AGREEING_VIEWS = 3
"""Views in a row that have to find the same loop before it is closed."""
AGREEING_PX, RUN_PX = 12.0, 60.0
"""Largest difference of their corrections, as image motion, and largest image motion from one to the next."""
MOST_DRIFT = 0.2
"""Largest correction of a view, as image motion, over the image motion of the loop. Chosen, not measured: drift of a
long path was below it, and two equal parts of a room may be nearer (decision 19)."""
RIVAL = 0.6
"""Points of another place that agree, over those of the best one, from which on the two cannot be told apart."""
COARSE_LEVELS, FINE_LEVELS = 4, 2
"""Pyramid levels of the search around the projections, and around their common shift."""
LOOP_REACH_PX = 0.6
"""Largest forward-backward error of a point found again."""
LEAST_COS = 0.85
"""Cosine of the largest angle between the optical axes of two views of a loop."""
CLOSURE_INLIER_PX = 1.5 * INLIER_PX
"""Largest residual of a point that agrees with the pose."""
MOST_SCALE = 1.25
"""Largest drift of the scale, and its inverse the least, that is taken from the closures' positions."""
LEAST_SPREAD = 0.01
"""RMS distance of the closures' positions, in units of the first views' depth, that a scale is taken from."""
DRIFT_STEPS = 200
"""Steps in which the drift is spread over the points."""


@dataclass(frozen=True)
class LoopClosure:
    """A later view that sees points of an earlier one again."""

    earlier: TrackedView
    later: TrackedView
    ids: NDArray[np.int64]
    """[n] tracks of the earlier view."""
    pixels: Array
    """[n, 2] px where the later view sees them."""
    before: Pose
    """Of the later view, by the path so far."""
    pose: Pose
    """Of the later view, by the points of the earlier one."""

    share: float
    """Of the points found again, those that agree with the pose."""
    depth: float
    """Median depth of the points."""

    def correction_px(self, intrinsics: Intrinsics) -> float:
        """How far the closure moves the image of the later view."""
        return shift_px(intrinsics, self.before, self.pose, self.depth)

    def add_tracks(self) -> None:
        """Let the later view observe the points of the earlier one."""
        new = ~np.isin(self.ids, self.later.ids)
        self.later.ids = np.concatenate([self.later.ids, self.ids[new]])
        self.later.pixels = np.concatenate([self.later.pixels, self.pixels[new]])


@dataclass
class LoopSearch:
    """Searches each kept view for places seen before, and believes them when several views in a row agree."""

    map: SparseMap
    pictures: Mapping[int, Picture]
    """Images of the kept views by id."""
    index: PlaceIndex
    every_px: float = EVERY_PX
    _searched_px: float = -np.inf
    """Image motion up to the newest view that was searched, and up to the newest place with features."""
    _place_px: float = -np.inf
    _run: list[LoopClosure] = field(default_factory=list)
    """Closures of views in a row that agree."""

    @classmethod
    def of(cls, sparse_map: SparseMap, pictures: Mapping[int, Picture], every_px: float = EVERY_PX) -> "LoopSearch":
        """On the kept views so far, among which there are no loops."""
        made = cls(sparse_map, pictures, PlaceIndex(sparse_map), every_px)
        made.add_kept(sparse_map.views[number] for number in sorted(pictures))
        return made

    def search(self, view: TrackedView) -> list[LoopClosure]:
        """Closures to be applied: of a new kept view, and of those just before it that it confirms."""
        travelled_px = self.map.travelled_px(view.id)
        if self._run and travelled_px - self.map.travelled_px(self._run[-1].later.id) > RUN_PX:
            self._run = []
        undecided = 0 < len(self._run) < AGREEING_VIEWS
        if view.pose is None or (not undecided and travelled_px - self._searched_px < self.every_px):
            return []
        found = find_by_path(self.map, self.pictures, self.index, view, self._expected(view))
        if (features := self._add(view, known=found is not None)) is not None:
            found = self._find_by_features(view, features)
        return [] if found is None else self._confirmed(found)

    def recognise(self, view: TrackedView, pictures: Mapping[int, Picture]) -> LoopClosure | None:
        """Where a view without a pose was taken, by the places that look alike; `pictures` has its image, too.

        The view is not added to the places.
        """
        found = [
            find_by_path(self.map, pictures, self.index, view, pose, before_px=np.inf)
            for pose, _ in self.index.drawn_poses(place_features(pictures[view.id]), np.inf)
        ]
        return self._best([one for one in found if one is not None])

    def add_kept(self, views: Iterable[TrackedView]) -> None:
        """Add kept views, in order of time, in which no place is searched."""
        for view in views:
            self._add(view)

    def forget(self) -> None:
        """The newest closures are not applied: the path is about to change, and they are to be found again."""
        self._run = []

    def closed(self) -> None:
        """The path was corrected by the newest closures."""
        self._run = [replace(one, before=one.pose) for one in self._run]

    def _expected(self, view: TrackedView) -> Pose:
        """Where a view should be, by the path, and by the undecided closures before it."""
        assert view.pose is not None
        return view.pose.carried(self._run[-1].before, self._run[-1].pose) if self._run else view.pose

    def _add(self, view: TrackedView, known: bool = False) -> Features | None:
        """Add a view to the index; its features, if its place is kept with them: not if the place is `known`, so that
        they grow with what the camera sees and not with time."""
        travelled_px = self.map.travelled_px(view.id)
        if travelled_px - self._searched_px < self.every_px:
            return None
        self._searched_px = travelled_px
        self.index.add(view)
        if known or travelled_px - self._place_px < PLACE_PX:
            return None
        self._place_px = travelled_px
        features = place_features(self.pictures[view.id])
        self.index.add_features(view, features)
        return features

    def _find_by_features(self, view: TrackedView, features: Features) -> LoopClosure | None:
        """The loop of a view with a place that looks alike, wherever the path says that it is."""
        assert view.pose is not None
        before_px = self.map.travelled_px(view.id) - LEAST_APART_PX
        found: list[LoopClosure] = []
        for pose, _ in self.index.drawn_poses(features, before_px):
            one = find_by_path(self.map, self.pictures, self.index, view, pose)
            if one is not None and self._plausible(one):
                found.append(one)
        return self._best(found)

    def _best(self, found: list[LoopClosure]) -> LoopClosure | None:
        """The one that most points agree with; None if another place explains the view about equally."""
        if not found:
            return None
        best = max(found, key=lambda one: len(one.ids))
        for one in found:
            elsewhere = shift_px(self.map.intrinsics, best.pose, one.pose, best.depth) > AGREEING_PX
            if elsewhere and len(one.ids) > RIVAL * len(best.ids):
                return None
        return best

    def _plausible(self, closure: LoopClosure) -> bool:
        way_px = self.map.travelled_px(closure.later.id) - self.map.travelled_px(closure.earlier.id)
        return closure.correction_px(self.map.intrinsics) < MOST_DRIFT * way_px

    def _confirmed(self, found: LoopClosure) -> list[LoopClosure]:
        """The closures to be applied after another one was found."""
        if not self._plausible(found):
            return []
        expected = self._expected(found.later)
        if self._run and shift_px(self.map.intrinsics, expected, found.pose, found.depth) > AGREEING_PX:
            self._run = []
        self._run.append(found)
        if len(self._run) < AGREEING_VIEWS:
            return []
        new = self._run if len(self._run) == AGREEING_VIEWS else self._run[-1:]
        self._run = self._run[-AGREEING_VIEWS - 1 :]
        return list(new)


def find_closures(sparse_map: SparseMap, pictures: Mapping[int, Picture], index: PlaceIndex) -> list[LoopClosure]:
    """Loops of the whole path, where the path says that a place is seen again: at most one for each kept view."""
    found = (
        find_by_path(sparse_map, pictures, index, view, view.pose)
        for view in map(sparse_map.views.__getitem__, index.numbers)
        if view.pose is not None and view.id in pictures
    )
    return [one for one in found if one is not None]


def find_by_path(
    sparse_map: SparseMap,
    pictures: Mapping[int, Picture],
    index: PlaceIndex,
    view: TrackedView,
    expected: Pose,
    before_px: float | None = None,
) -> LoopClosure | None:
    """The loop of a view, taken to be at `expected`, with the earlier one of which it should see most points again.

    It lies before so much image motion; by default `LEAST_APART_PX` before the view.
    """
    known = sparse_map.known_tracks(view)[0]
    depth = median((sparse_map.points[known] - expected.centre) @ expected.rotation[:, 2]) if len(known) else 1.0
    before_px = sparse_map.travelled_px(view.id) - LEAST_APART_PX if before_px is None else before_px
    best, most = None, LEAST_INSIDE
    for other in index.near(expected, max(depth, LEAST_DEPTH), before_px, COMPARED):
        assert other.rotation is not None
        if other.id not in pictures:
            continue
        ids = sparse_map.known_tracks(other)[0]
        if len(ids) < LEAST_MATCHES or other.rotation[:, 2] @ expected.rotation[:, 2] < LEAST_COS:
            continue
        if np.isin(ids, view.ids).sum() > MOST_SHARED:
            continue
        share = float(sparse_map.project_into(ids, expected, pictures[view.id].shape)[0].mean())
        if share > most:
            best, most = other, share
    return None if best is None else _match(sparse_map, best, view, expected, pictures)


def spread_drift(sparse_map: SparseMap, found: list[LoopClosure]) -> list[LoopClosure]:
    """Correct views and points by the mean similarity of the closures of the path's first open loop, in proportion to
    the image motion since the last earlier view of that loop; returns these closures.

    The adjustment that follows closes each loop by itself. Closures of later loops have to be searched again.
    """
    if not found:
        return []
    travelled_px = np.array([sparse_map.travelled_px(view.id) for view in sparse_map.views])
    first = min((closure.later for closure in found), key=lambda view: view.id)
    closures = [
        closure
        for closure in found
        if closure.earlier.id < first.id and travelled_px[closure.later.id] < travelled_px[first.id] + LOOP_SPAN_PX
    ]
    pivot = max((closure.earlier for closure in closures), key=lambda view: view.id)
    begin, end = travelled_px[pivot.id], travelled_px[first.id]
    if pivot.pose is None or end <= begin:
        return []
    drift = _Drift.of(closures, pivot.pose.centre)
    shares = np.clip((travelled_px - begin) / (end - begin), 0.0, 1.0)
    places, seen = np.zeros(len(sparse_map.points)), np.zeros(len(sparse_map.points))
    for view in sparse_map.views:
        if view.pose is not None:
            places[view.ids] += shares[view.id]
            seen[view.ids] += 1
            part = drift.part(float(shares[view.id]))
            view.pose = Pose(part.rotation @ view.pose.rotation, part.points(view.pose.centre))
            view.scale *= part.scale
    steps = np.round(DRIFT_STEPS * places / np.maximum(seen, 1)).astype(np.int64)
    for step in np.unique(steps).tolist():
        chosen = steps == step
        sparse_map.points[chosen] = drift.part(step / DRIFT_STEPS).points(sparse_map.points[chosen])
    return closures


@dataclass(frozen=True)
class _Drift:
    """Similarity pivot + shift + scale rotation (x - pivot)."""

    scale: float
    rotation: Array
    """[3, 3]"""
    pivot: Array
    """[3], the centre of the rotation and the scale: the last earlier view of a loop."""
    shift: Array
    """[3], of the pivot."""

    @classmethod
    def of(cls, closures: list[LoopClosure], pivot: Array) -> "_Drift":
        """From the path so far to the poses of the closures: mean rotation, and scale of their positions."""
        before, after = (np.stack([pose.centre for pose in poses]) for poses in zip(*_poses(closures), strict=True))
        rotation = mean_rotation(np.stack([new.rotation @ old.rotation.T for old, new in _poses(closures)]))
        a, b = (before - before.mean(0)) @ rotation.T, after - after.mean(0)
        scale = float((a * b).sum() / max(float((a**2).sum()), 1e-12))
        spread = float(np.sqrt((a**2).sum(1).mean()))
        if spread < LEAST_SPREAD or not 1 / MOST_SCALE < scale < MOST_SCALE:
            scale = 1.0
        shift = after.mean(0) - pivot - scale * rotation @ (before.mean(0) - pivot)
        return cls(scale, rotation, pivot, shift)

    def part(self, share: float) -> "_Drift":
        """A share of it, from 0 (the identity) to 1."""
        rotation = exp_so3(share * log_so3(self.rotation))
        return _Drift(self.scale**share, rotation, self.pivot, share * self.shift)

    def points(self, points: Array) -> Array:
        """Transform points [..., 3]."""
        return np.asarray(self.pivot + self.shift + self.scale * (points - self.pivot) @ self.rotation.T)


def _poses(closures: list[LoopClosure]) -> list[tuple[Pose, Pose]]:
    return [(closure.before, closure.pose) for closure in closures]


def shift_px(intrinsics: Intrinsics, a: Pose, b: Pose, depth: float) -> float:
    """How far the image moves from one pose to another, at most, for points at `depth`."""
    return float(shifts_px(intrinsics, a.rotation, a.centre, b, depth))


def _match(
    sparse_map: SparseMap, earlier: TrackedView, later: TrackedView, expected: Pose, pictures: Mapping[int, Picture]
) -> LoopClosure | None:
    """The loop of two views if enough points of the earlier one are found in the later one, taken to be at `expected`,
    and agree with one pose."""
    ids, pixels = sparse_map.known_tracks(earlier)
    images = pictures[earlier.id], pictures[later.id]
    inside, guess = sparse_map.project_into(ids, expected, images[1].shape)
    ids, pixels, guess = ids[inside], pixels[inside], guess[inside]
    at, good = flow(*images, pixels, guess, LOOP_REACH_PX, levels=COARSE_LEVELS)
    if good.sum() < LEAST_MATCHES:
        return None
    # Drift shifts the whole image alike: once more from the shift that most points follow.
    at, good = flow(*images, pixels, guess + np.median((at - guess)[good], axis=0), LOOP_REACH_PX, levels=FINE_LEVELS)
    if good.sum() < LEAST_MATCHES:
        return None
    seen = replace(later, ids=ids[good], pixels=at[good])
    fit = fit_pose(sparse_map, seen, expected)
    agree = sparse_map.errors_px(seen, fit.pose) < CLOSURE_INLIER_PX
    if agree.sum() < LEAST_MATCHES or agree.mean() < LEAST_AGREEING:
        return None
    depth = median((sparse_map.points[seen.ids[agree]] - fit.pose.centre) @ fit.pose.rotation[:, 2])
    share = float(agree.mean())
    before = later.pose or expected
    return LoopClosure(earlier, later, seen.ids[agree], seen.pixels[agree], before, fit.pose, share, depth)
