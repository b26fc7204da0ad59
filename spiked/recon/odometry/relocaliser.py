"""Relocalisation: matches the points of keyframes in a view after tracking was lost."""

from dataclasses import dataclass, field, replace

import numpy as np

from spiked.recon.frontend.feature_tracks import Picture, flow, search
from spiked.recon.odometry.initialisation import INLIER_PX
from spiked.recon.odometry.pnp import MIN_POINTS, PnPResult, fit_pose
from spiked.recon.odometry.sparse_map import SparseMap, TrackedView

KEYFRAME_EVERY = 8
"""Every eighth view is a keyframe, if it has a pose."""
NEWEST_KEYFRAMES, OLDER_KEYFRAMES = 3, 12
"""Keyframes tried: the newest, and about so many of the older ones, evenly spaced."""
RELOCALISED_CHI2, RELOCALISED_INLIERS = 4.0, 0.6
"""Relocalisation needs points within twice their noise: blurred views match much by chance (decision 10)."""
REPROJECTION_SEARCH_PX = (0.5, 4.0)
"""Largest forward-backward error of a keyframe point matched again, and its largest distance from the projection."""
REPROJECTED_INLIER_PX = 2 * INLIER_PX
"""Largest residual of a matched point that becomes a track again."""


@dataclass
class Relocaliser:
    """Keyframes of a map, and the search for their points in a view."""

    map: SparseMap
    keyframes: dict[int, Picture] = field(default_factory=dict)
    """Images of the keyframes by view id."""

    def remember(self, view: TrackedView, picture: Picture) -> None:
        """Keep the image of a view with a pose if it is a keyframe."""
        if view.pose is not None and view.id % KEYFRAME_EVERY == 0:
            self.keyframes[view.id] = picture

    def find(self, view: TrackedView, picture: Picture) -> PnPResult | None:
        """The pose of a lost view by the points of a keyframe; the matched points become the tracks of the view.

        None if no keyframe matches; the view is then unchanged.
        """
        numbers = sorted(self.keyframes)
        older = numbers[:-NEWEST_KEYFRAMES][:: max(1, len(numbers) // OLDER_KEYFRAMES)]
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
        for number in sorted(self.keyframes, reverse=True):
            ids, pixels = self.map.known_tracks(self.map.views[number])
            new = ~np.isin(ids, view.ids)
            ids, pixels = ids[new], pixels[new]
            inside, guess = self.map.project_into(ids, fit.pose, picture.shape)
            if not inside.any():
                continue
            ids, guess = ids[inside], guess[inside]
            at, good = flow(self.keyframes[number], picture, pixels[inside], guess, REPROJECTION_SEARCH_PX[0], levels=1)
            good &= np.linalg.norm(at - guess, axis=1) < REPROJECTION_SEARCH_PX[1]
            view.ids, view.pixels = np.concatenate([view.ids, ids[good]]), np.concatenate([view.pixels, at[good]])
        fit = fit_pose(self.map, view, fit.pose)
        agree = self.map.errors_px(view, fit.pose) < REPROJECTED_INLIER_PX
        view.ids, view.pixels = view.ids[agree], view.pixels[agree]
        return fit_pose(self.map, view, fit.pose)
