"""Relocalisation: matches the points of keyframes in a view after tracking was lost."""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from spiked.pose import Array
from spiked.recon.frontend.feature_tracks import Picture, Pyramid, follow, pyramid, search
from spiked.recon.odometry.initialisation import INLIER_PX
from spiked.recon.odometry.keyframe_pictures import KeyframePictures
from spiked.recon.odometry.pnp import MIN_POINTS, PnPResult, fit_pose
from spiked.recon.odometry.sparse_map import Pose, SparseMap, TrackedView

KEYFRAME_EVERY = 8
"""Every eighth view is a keyframe, if it has a pose."""
NEWEST_KEYFRAMES, OLDER_KEYFRAMES = 3, 12
"""Keyframes tried: the newest, and about so many of the older ones, evenly spaced."""
LIVE_OLDER_KEYFRAMES = 4
"""Of these, those tried in a view of a live camera, in turn: a search takes 3 ms, and more views come meanwhile."""
RELOCALISED_CHI2, RELOCALISED_INLIERS = 4.0, 0.6
"""Relocalisation needs points within twice their noise: blurred views match much by chance (decision 10)."""
MAX_RETURN_PX = 0.5
"""Largest forward-backward error of a keyframe point matched again."""
REPROJECTION_RADIUS_PX = 4.0
"""Largest distance of such a point from its projection after tracking was lost."""
REPROJECTED_INLIER_PX = 2 * INLIER_PX
"""Largest residual of a matched point that becomes a track again."""
RECOVERY_KEYFRAMES = 50
"""Newest keyframes whose points are searched again in a view: most of the motion across an image (decision 15)."""
RECOVERY_RADIUS_PX = 3.0
"""Largest distance of a recovered point from its projection."""


@dataclass
class Relocaliser:
    """Keyframes of a map, and the search for their points in a view."""

    map: SparseMap
    keyframes: KeyframePictures = field(default_factory=KeyframePictures)
    """Images of the keyframes by view id."""
    least_motion_px: float = 0.0
    """Image motion from one keyframe to the next, at least: with more than 0 a camera at rest adds none."""
    most_motion_px: float = np.inf
    """Image motion after which a view is a keyframe whatever its number: views of a live camera may lie far apart."""
    older_tried: int | None = None
    """Older keyframes tried in one view, if not all: the others are tried in those after it."""
    _next_older: int = 0
    _moved_px: float = 0.0
    """Image motion since the newest keyframe."""

    def remember(self, view: TrackedView, picture: Picture) -> bool:
        """Keep the image of a view with a pose if it is a keyframe; returns whether it is."""
        self._moved_px += view.moved_px
        due = view.id % KEYFRAME_EVERY == 0 and self._moved_px >= self.least_motion_px
        if view.pose is not None and (due or self._moved_px >= self.most_motion_px):
            self.keyframes[view.id] = picture
            self._moved_px = 0.0
            return True
        return False

    def recover(self, view: TrackedView, picture: Picture) -> tuple[NDArray[np.int64], Array]:
        """Ids [n] and places [n, 2] px, in a view with a pose, of points of recent keyframes without a track in it."""
        assert view.pose is not None
        last_seen = np.full(len(self.map.points), -1)
        for number in list(self.keyframes)[-RECOVERY_KEYFRAMES:]:
            last_seen[self.map.views[number].ids] = number
        last_seen[view.ids] = -1
        ids = np.flatnonzero((last_seen >= 0) & np.isfinite(self.map.points[:, 0]))
        levels = pyramid(picture, 1)
        found, at = [view.ids[:0]], [view.pixels[:0]]
        for number in np.unique(last_seen[ids]).tolist():
            of = ids[last_seen[ids] == number]
            pixels = self.map.views[number].pixels_of(of)
            more, places = self._find_near_projections(number, of, pixels, view.pose, levels, RECOVERY_RADIUS_PX)
            found.append(more)
            at.append(places)
        new = np.concatenate(found)
        order = np.argsort(new)
        return new[order], np.concatenate(at)[order]

    def _find_near_projections(
        self, number: int, ids: NDArray[np.int64], pixels: Array, pose: Pose, levels: Pyramid, radius_px: float
    ) -> tuple[NDArray[np.int64], Array]:
        """Those of the known points `ids` [n], at `pixels` [n, 2] of a keyframe, that are found in an image less than
        `radius_px` from where `pose` projects them: ids [m] and places [m, 2] px."""
        picture = self.keyframes[number]
        inside, guess = self.map.project_into(ids, pose, picture.shape)
        ids, pixels, guess = ids[inside], pixels[inside], guess[inside]
        if not len(ids):
            return ids, guess
        at, good = follow(pyramid(picture, 1), levels, pixels, guess, MAX_RETURN_PX)
        good &= np.linalg.norm(at - guess, axis=1) < radius_px
        return ids[good], at[good]

    def find(self, view: TrackedView, picture: Picture) -> PnPResult | None:
        """The pose of a lost view by the points of a keyframe; the matched points become the tracks of the view.

        None if no keyframe matches; the view is then unchanged.
        """
        numbers = sorted(self.keyframes)
        older = numbers[:-NEWEST_KEYFRAMES][:: max(1, len(numbers) // OLDER_KEYFRAMES)]
        if self.older_tried is not None and older:
            begin = self._next_older % len(older)
            older = (older[begin:] + older[:begin])[: self.older_tried]
            self._next_older = begin + self.older_tried
        for number in reversed(numbers[-NEWEST_KEYFRAMES:] + older):
            key = self.map.views[number]
            ids, pixels = self.map.known_tracks(key)
            if len(ids) < MIN_POINTS or key.pose is None:
                continue
            at, good = search(self.keyframes[number], picture, pixels)
            if good.sum() < MIN_POINTS:
                continue
            seen = replace(view, ids=ids[good], pixels=at[good])
            fit = fit_pose(self.map, seen, key.pose)
            if fit.points >= MIN_POINTS and fit.inliers > RELOCALISED_INLIERS and fit.chi2 < RELOCALISED_CHI2:
                fit = self._reproject_keyframe_points(seen, picture, fit)
                view.ids, view.pixels = seen.ids, seen.pixels
                return fit
        return None

    def _reproject_keyframe_points(self, view: TrackedView, picture: Picture, fit: PnPResult) -> PnPResult:
        """Search the points of all keyframes near their projections in a view: they fix scale and pose."""
        levels = pyramid(picture, 1)
        for number in sorted(self.keyframes, reverse=True):
            ids, pixels = self.map.known_tracks(self.map.views[number])
            new = ~np.isin(ids, view.ids)
            ids, at = self._find_near_projections(
                number, ids[new], pixels[new], fit.pose, levels, REPROJECTION_RADIUS_PX
            )
            view.ids, view.pixels = np.concatenate([view.ids, ids]), np.concatenate([view.pixels, at])
        fit = fit_pose(self.map, view, fit.pose)
        agree = self.map.errors_px(view, fit.pose) < REPROJECTED_INLIER_PX
        view.ids, view.pixels = view.ids[agree], view.pixels[agree]
        return fit_pose(self.map, view, fit.pose)
