"""Loop closure: views that see points of much earlier views again, and the correction of the path between them."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from spiked.pose import Array, exp_so3, log_so3, mean_rotation
from spiked.recon.frontend.feature_tracks import Picture, flow
from spiked.recon.odometry.initialisation import INLIER_PX
from spiked.recon.odometry.pnp import fit_pose
from spiked.recon.odometry.sparse_map import Pose, SparseMap, TrackedView

LEAST_APART_PX = 300.0
"""Image motion between two views of a loop, at least: nearer ones share tracks (decision 15)."""
EVERY_PX = 10.0
"""Image motion from one view in which loops are searched to the next: a camera that stands still adds none (decision
15)."""
LOOP_SPAN_PX = 500.0
"""Image motion over which the closures of one loop may lie: their drift is taken as one."""
MOST_SHARED = 15
"""Tracks that two views of a loop share, at most (decision 15)."""
LEAST_INSIDE = 0.4
"""Share of the points of the earlier view that project into the later one by the path so far."""
LEAST_MATCHES = 30
"""Points that are found again, and agree with one pose (decision 15)."""
LEAST_AGREEING = 0.7
"""Share of the points found that agree with one pose (decision 15)."""
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

    def add_tracks(self) -> None:
        """Let the later view observe the points of the earlier one."""
        new = ~np.isin(self.ids, self.later.ids)
        self.later.ids = np.concatenate([self.later.ids, self.ids[new]])
        self.later.pixels = np.concatenate([self.later.pixels, self.pixels[new]])


def find_closures(sparse_map: SparseMap, pictures: Mapping[int, Picture]) -> list[LoopClosure]:
    """Loops among the views whose images are in `pictures` (by view id), one for each later view."""
    travelled_px = _travelled_px(sparse_map)
    numbers = _spaced([n for n in sorted(pictures) if sparse_map.views[n].pose is not None], travelled_px)
    views = [sparse_map.views[n] for n in numbers]
    axes = np.stack([view.rotation[:, 2] for view in views if view.rotation is not None]) if views else np.zeros((0, 3))
    known = [sparse_map.known_tracks(view)[0] for view in views]
    found = []
    for view, axis in zip(views, axes, strict=True):
        assert view.pose is not None
        far = travelled_px[numbers] < travelled_px[view.id] - LEAST_APART_PX
        best, most = None, LEAST_INSIDE
        for row in np.flatnonzero(far & (axes @ axis > LEAST_COS)).tolist():
            ids = known[row]
            if len(ids) < LEAST_MATCHES or np.isin(ids, view.ids).sum() > MOST_SHARED:
                continue
            share = float(sparse_map.project_into(ids, view.pose, pictures[view.id].shape)[0].mean())
            if share > most:
                best, most = views[row], share
        closure = None if best is None else _match(sparse_map, best, view, pictures)
        if closure is not None:
            found.append(closure)
    return found


def spread_drift(sparse_map: SparseMap, found: list[LoopClosure]) -> list[LoopClosure]:
    """Correct views and points by the mean similarity of the closures of the path's first open loop, in proportion to
    the image motion since the last earlier view of that loop; returns these closures.

    The adjustment that follows closes each loop by itself. Closures of later loops have to be searched again.
    """
    if not found:
        return []
    travelled_px = _travelled_px(sparse_map)
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


def _travelled_px(sparse_map: SparseMap) -> Array:
    """Image motion up to each view."""
    return np.cumsum([view.moved_px for view in sparse_map.views])


def _spaced(numbers: list[int], travelled_px: Array) -> NDArray[np.int64]:
    """Those of the ascending view ids that are `EVERY_PX` of image motion apart."""
    out: list[int] = []
    for number in numbers:
        if not out or travelled_px[number] - travelled_px[out[-1]] >= EVERY_PX:
            out.append(number)
    return np.array(out, np.int64)


def _match(
    sparse_map: SparseMap, earlier: TrackedView, later: TrackedView, pictures: Mapping[int, Picture]
) -> LoopClosure | None:
    """The loop of two views if enough points of the earlier one are found in the later one and agree with one pose."""
    before = later.pose
    assert before is not None
    ids, pixels = sparse_map.known_tracks(earlier)
    inside, guess = sparse_map.project_into(ids, before, pictures[later.id].shape)
    ids, pixels, guess = ids[inside], pixels[inside], guess[inside]
    images = pictures[earlier.id], pictures[later.id]
    at, good = flow(*images, pixels, guess, LOOP_REACH_PX, levels=COARSE_LEVELS)
    if good.sum() < LEAST_MATCHES:
        return None
    # Drift shifts the whole image alike: once more from the shift that most points follow.
    at, good = flow(*images, pixels, guess + np.median((at - guess)[good], axis=0), LOOP_REACH_PX, levels=FINE_LEVELS)
    if good.sum() < LEAST_MATCHES:
        return None
    seen = replace(later, ids=ids[good], pixels=at[good])
    fit = fit_pose(sparse_map, seen, before)
    agree = sparse_map.errors_px(seen, fit.pose) < CLOSURE_INLIER_PX
    if agree.sum() < LEAST_MATCHES or agree.mean() < LEAST_AGREEING:
        return None
    return LoopClosure(earlier, later, seen.ids[agree], seen.pixels[agree], before, fit.pose)
