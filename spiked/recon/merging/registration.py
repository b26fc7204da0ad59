"""The similarity between two maps of one place: views of one are recognised in the other, and have to agree."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spiked.errors import SpikedError
from spiked.evaluate import Similarity
from spiked.pose import Array, exp_so3, hat
from spiked.recon.frontend.feature_tracks import LEVELS, pyramid
from spiked.recon.localisation.alignment import NEAR_LEVELS, Anchor
from spiked.recon.localisation.map_index import NOMINAL_WIDTH_PX, MapIndex
from spiked.recon.localisation.map_views import MapView
from spiked.recon.localisation.recognition import RIVAL, accepted
from spiked.recon.localisation.search import Candidate, candidate_at, search
from spiked.recon.merging.known_map import inverse
from spiked.recon.merging.path_warp import PathWarp
from spiked.recon.odometry.sparse_map import Pose
from spiked.recon.statistics import RAYLEIGH_MEDIAN, median

LEAST_VIEWS = 3
"""Views of one map that have to find the same similarity to the other."""
ROUGH_PX, AGREES_PX = 30.0, 8.0
"""Image shift at a width of `NOMINAL_WIDTH_PX` from where a view was found to where the similarity puts it: of views
that it is first fitted to, and of views that agree with it."""
RIVAL_SHARE = 0.5
"""Views that agree on another similarity, over those that agree on the best one, from which on neither is believed."""
STARTS = 8
"""Views whose own similarity is tried as a start, those with the most agreement first."""
ROUNDS, STEPS = 3, 10
"""Times that the agreeing views are chosen again, and Gauss-Newton steps in each."""
BATCH, ENOUGH_VIEWS = 12, 8
"""Views searched for between two looks at whether enough agree, and how many are enough."""
GOLDEN = 0.6180339887498949
"""Share of a circle by which one view follows the other, so that the first ones are spread evenly: the golden ratio."""
FOLLOWED_PX = 60.0
"""Largest shift as `AGREES_PX`, of a view that is found near others: a map may be distorted along its way."""
NEIGHBOURS, LOCAL_STEPS = 2, 4
"""Views before and after one that its own similarity is fitted to, and Gauss-Newton steps of that."""
PIXEL_SCALE_PX = 1.0
"""Scale of the robust loss of a point's position in the image."""
DEPTH_SCALE = 0.05
"""Scale of the robust loss of the logarithm of a point's depth: rendered depths are noisy by 10 %."""
SYSTEMATIC = 3.5
"""Factor on predicted deviations, as `alignment.SYSTEMATIC`: errors of neighbouring points of a map are alike."""


class NotOnePlaceError(SpikedError):
    """Two maps do not show the same place, or it cannot be said how they lie to each other."""


@dataclass(frozen=True)
class Sighting:
    """A view of the second map that was recognised in the first."""

    time: float
    """Of the view, on the second map's way."""
    own: Pose
    """In the second map."""
    found: Pose
    """In the first map."""
    anchor: Anchor
    """The first map rendered there."""
    points: Array
    """[n, 3] in the first map."""
    pixels: Array
    """[n, 2] px, where they appear in the view."""
    depths: Array
    """[n], depth of these pixels in the second map; NaN where it has no clear surface."""

    def similarity(self) -> Similarity:
        """From the second map to the first, by this view alone."""
        there = (self.points - self.found.centre) @ self.found.rotation[:, 2]
        scale = float(np.exp(np.nanmedian(np.log(there / self.depths))))
        rotation = self.found.rotation @ self.own.rotation.T
        return Similarity(scale, rotation, self.found.centre - scale * rotation @ self.own.centre)

    def carry(self, pose: Pose, scale: float) -> tuple[Array, Array]:
        """A pose of the second map in the first, as it lies to this view; `scale` is from the second to the first."""
        turn = self.found.rotation @ self.own.rotation.T
        return turn @ pose.rotation, self.found.centre + scale * turn @ (pose.centre - self.own.centre)

    def shift_px(self, similarity: Similarity) -> float:
        """Image shift from where the view was found to where a similarity puts it."""
        rotation, centre = similarity.poses(self.own.rotation, self.own.centre)
        return self.anchor.shift_px(Pose(rotation, centre))


@dataclass(frozen=True)
class Registration:
    """How the second map lies in the first."""

    similarity: Similarity
    """From the second map to the first, for all of it."""
    warp: PathWarp
    """The same for each part of the second map's way: the two maps are distorted differently."""
    scale_sigma: float
    """Predicted relative standard deviation of the scale."""
    turn_sigma_deg: float
    """Predicted standard deviation of the rotation, root of the sum over its axes."""
    shift_sigma: float
    """Predicted standard deviation of the place of the middle of the common points, in the first map's unit."""
    searched: int
    """Views of the second map that were searched for in the whole first one."""
    recognised: int
    """Views that were found by these searches."""
    sightings: Sequence[Sighting]
    """Views that agree, in the order of time; some were found near others, without a search."""
    residual_px: float
    """Median distance of the common points from where the similarity puts them."""


@dataclass(frozen=True)
class MapPlace:
    """A place of the second map's way, and what the map shows from it."""

    time: float
    view: MapView


def register(index: MapIndex, places: Sequence[MapPlace]) -> Registration:
    """How the map that `places` are of, in the order of time, lies in the map of `index`.

    The index is for the camera of the places. Places are searched in the whole first map until enough agree; the others
    are then looked for where those let them expect. Raises NotOnePlaceError.
    """
    sightings: list[Sighting] = []
    order, searched = _spread(len(places)), 0
    best, agreeing = None, list[Sighting]()
    while searched < len(places) and len(agreeing) < ENOUGH_VIEWS:
        for row in order[searched : searched + BATCH]:
            if (one := search_place(index, places[row])) is not None:
                sightings.append(one)
        searched = min(searched + BATCH, len(places))
        if len(sightings) >= LEAST_VIEWS:
            best, agreeing = _largest(sightings, index.camera.width / NOMINAL_WIDTH_PX)
    if best is None or len(sightings) < LEAST_VIEWS:
        raise NotOnePlaceError(
            f"these two do not show the same place: {len(sightings)} of {len(places)} views of the second map are "
            f"recognised in the first, {LEAST_VIEWS} needed"
        )
    _check(index, sightings, agreeing)
    agreeing += _follow(index, [places[row] for row in order[searched:]], agreeing, best)
    agreeing.sort(key=lambda one: one.time)
    similarity, residual_px, sigmas = _adjusted(agreeing, best, STEPS)
    warp = PathWarp(np.array([one.time for one in agreeing]), _local(agreeing, similarity))
    return Registration(similarity, warp, *sigmas, searched, len(sightings), agreeing, residual_px)


def _spread(count: int) -> list[int]:
    """Numbers below `count` in an order in which the first ones are spread over all."""
    steps = (np.arange(count) * GOLDEN) % 1
    return [int(row) for row in np.argsort(np.argsort(steps))] if count else []


def search_place(index: MapIndex, place: MapPlace) -> Sighting | None:
    """Search a place of the second map in the whole first one; None if it is not there beyond doubt."""
    found = search(index, place.view.picture)
    if not found.candidates or not accepted(found.candidates[0]):
        return None
    best, *others = found.candidates
    if any(one.score > RIVAL * best.score for one in others):
        return None
    return _sighting(index, place, best)


def _sighting(index: MapIndex, place: MapPlace, best: Candidate) -> Sighting | None:
    view, pose = place.view, best.fit.pose
    matched = best.anchor.find(pyramid(view.picture, LEVELS), pose, NEAR_LEVELS)
    column, row = (np.clip(matched.pixels[:, axis].astype(int), 0, view.depth.shape[1 - axis] - 1) for axis in (0, 1))
    depths = np.where(view.sound[row, column], view.depth[row, column], np.nan)
    local = (matched.points - pose.centre) @ pose.rotation
    error = np.linalg.norm(index.camera.intrinsics.project(local) - matched.pixels, axis=1)
    good = (error < 3 * PIXEL_SCALE_PX) & (local[:, 2] > 0)
    if not np.isfinite(depths[good]).any():
        return None
    return Sighting(place.time, view.pose, pose, best.anchor, matched.points[good], matched.pixels[good], depths[good])


def _check(index: MapIndex, sightings: list[Sighting], agreeing: list[Sighting]) -> None:
    """Raises NotOnePlaceError unless many more sightings agree on one placement than on any other."""
    rest = [one for one in sightings if one not in agreeing]
    rivals = len(_largest(rest, index.camera.width / NOMINAL_WIDTH_PX)[1]) if rest else 0
    if len(agreeing) < LEAST_VIEWS:
        raise NotOnePlaceError(
            f"these two do not show the same place: {len(sightings)} views of the second map look like places of the "
            f"first, and {len(agreeing)} of them agree on how the maps lie to each other, {LEAST_VIEWS} needed"
        )
    if rivals > RIVAL_SHARE * len(agreeing):
        raise NotOnePlaceError(
            f"it cannot be said how these two lie to each other: {len(agreeing)} views of the second map agree on one "
            f"placement and {rivals} on another; the place has parts that look alike, or a map is distorted"
        )


def _follow(index: MapIndex, places: list[MapPlace], known: list[Sighting], similarity: Similarity) -> list[Sighting]:
    """Places that are found where sightings near in time let them expect."""
    found: list[Sighting] = []
    for place in sorted(places, key=lambda one: min(abs(one.time - other.time) for other in known)):
        near = min([*known, *found], key=lambda one: abs(one.time - place.time))
        expected = Pose(*near.carry(place.view.pose, similarity.scale))
        candidate = candidate_at(index, place.view.picture, pyramid(place.view.picture, LEVELS), 0, expected)
        if candidate is None or not accepted(candidate):
            continue
        one = _sighting(index, place, candidate)
        if one is not None and one.shift_px(similarity) < FOLLOWED_PX * index.camera.width / NOMINAL_WIDTH_PX:
            found.append(one)
    return found


def _local(sightings: list[Sighting], similarity: Similarity) -> list[Similarity]:
    """The similarity of each sighting and its neighbours in time."""
    out = []
    for row in range(len(sightings)):
        begin = min(max(row - NEIGHBOURS, 0), max(len(sightings) - 2 * NEIGHBOURS - 1, 0))
        out.append(_adjusted(sightings[begin : begin + 2 * NEIGHBOURS + 1], similarity, LOCAL_STEPS)[0])
    return out


def _largest(sightings: list[Sighting], unit: float) -> tuple[Similarity, list[Sighting]]:
    """The similarity with the most sightings in agreement, and these."""
    starts = [one.similarity() for one in sightings]
    counts = [sum(one.shift_px(start) < ROUGH_PX * unit for one in sightings) for start in starts]
    best: tuple[Similarity, list[Sighting]] = starts[0], []
    for row in np.argsort(-np.array(counts), kind="stable")[:STARTS]:
        similarity, agreeing = starts[row], sightings
        for turn in range(ROUNDS):
            reach = (ROUGH_PX if turn == 0 else AGREES_PX) * unit
            agreeing = [one for one in sightings if one.shift_px(similarity) < reach]
            if not agreeing:
                break
            similarity = _adjusted(agreeing, similarity, STEPS)[0]
        agreeing = [one for one in agreeing if one.shift_px(similarity) < AGREES_PX * unit]
        if len(agreeing) > len(best[1]):
            best = similarity, agreeing
    return best


def _adjusted(
    sightings: list[Sighting], start: Similarity, steps: int
) -> tuple[Similarity, float, tuple[float, float, float]]:
    """Robust Gauss-Newton on the common points: their pixels in the views, and their depths there.

    Returns the similarity from the second map to the first, the median residual in px, and the predicted deviations of
    scale, rotation (degrees) and place.
    """
    back = inverse(start)
    middle = back.points(np.concatenate([one.points for one in sightings])).mean(0)
    residual_px, hessian = np.inf, np.eye(7)
    for _ in range(steps):
        hessian, gradient, residuals = np.zeros((7, 7)), np.zeros(7), []
        for one in sightings:
            part, slope, errors = _normals(one, back, middle)
            hessian, gradient = hessian + part, gradient + slope
            residuals.append(errors)
        residual_px = median(np.concatenate(residuals))
        step = np.asarray(-np.linalg.solve(hessian, gradient), np.float64)
        back = _stepped(back, step, middle)
        if np.abs(step).max() < 1e-9:
            break
    noise = SYSTEMATIC * residual_px / RAYLEIGH_MEDIAN / PIXEL_SCALE_PX
    covariance = noise**2 * np.linalg.inv(hessian)
    turn, shift, scale = (
        float(np.sqrt(np.trace(covariance[rows, rows]))) for rows in (slice(3), slice(3, 6), slice(6, 7))
    )
    return inverse(back), residual_px, (scale, float(np.degrees(turn)), shift / back.scale)


def _stepped(similarity: Similarity, step: Array, middle: Array) -> Similarity:
    """Turned, moved and scaled about a point: `step` is a rotation vector, a shift and a logarithm of a factor."""
    turn, factor = exp_so3(step[:3]), float(np.exp(step[6]))
    moved = factor * turn @ (similarity.translation - middle) + middle + step[3:6]
    return Similarity(factor * similarity.scale, turn @ similarity.rotation, moved)


def _normals(one: Sighting, back: Similarity, middle: Array) -> tuple[Array, Array, Array]:
    """Normal equations [7, 7] and [7] of a sighting by a step of `_stepped`, and its residuals [n] in px."""
    intrinsics = one.anchor.view.intrinsics
    world = back.points(one.points)
    arm = world - middle
    local = (world - one.own.centre) @ one.own.rotation
    z = np.maximum(local[:, 2], 1e-6)
    change = np.concatenate([-hat(arm), np.broadcast_to(np.eye(3), (len(arm), 3, 3)), arm[:, :, None]], 2)
    change = one.own.rotation.T @ change
    slope = change[:, :2] / z[:, None, None] - local[:, :2, None] / z[:, None, None] ** 2 * change[:, 2:]
    if intrinsics.distortion is None:
        slope = slope * np.array([intrinsics.fx, intrinsics.fy])[:, None] / PIXEL_SCALE_PX
    else:
        slope = intrinsics.by_slope(local[:, :2] / z[:, None]) @ slope / PIXEL_SCALE_PX
    error = (intrinsics.project(local) - one.pixels) / PIXEL_SCALE_PX
    size = np.linalg.norm(error, axis=1)
    weight = 1 / (1 + size**2)
    deep = np.isfinite(one.depths)
    depth_error = np.log(z[deep] / one.depths[deep]) / DEPTH_SCALE
    depth_slope = change[deep, 2] / z[deep, None] / DEPTH_SCALE
    depth_weight = 1 / (1 + depth_error**2)
    square = np.einsum("n,nai,naj->ij", weight, slope, slope)
    square = square + np.einsum("n,ni,nj->ij", depth_weight, depth_slope, depth_slope)
    gradient = np.einsum("n,nai,na->i", weight, slope, error) + (depth_weight * depth_error) @ depth_slope
    return square, gradient, size * PIXEL_SCALE_PX
