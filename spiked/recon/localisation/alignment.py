"""The pose of an image in a map: corners of a render are tracked into the image, and the pose follows from them."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from spiked.pose import Array
from spiked.recon.frontend.feature_tracks import LEVELS, Picture, Pyramid, follow
from spiked.recon.localisation.map_views import MapRenderer, MapView
from spiked.recon.odometry.pnp import FIT_SCALES_PX, LEAST_POINTS, solve_pose
from spiked.recon.odometry.sparse_map import Pose
from spiked.recon.statistics import RAYLEIGH_MEDIAN, median
from spiked.sensor import Intrinsics

CORNERS, SPACING_PX = 300, 9
"""Corners of a render, at most, and their least distance."""
REACH_PX = 0.6
"""Largest forward-backward error of a corner found in the image."""
AGREES_PX = 1.5
"""Largest residual of a corner that agrees with the pose."""
ROUNDS = 3
"""Renders of an alignment; the second lies within a fraction of a pixel of the final pose."""
NEAR_LEVELS = 2
"""Pyramid levels of all but the first: corners are then within a few pixels of their projections."""
BLUR_PX, BAND_PX = 1.0, 6.0
"""Standard deviations of the Gaussians whose difference is correlated: finer is noise, coarser is light and
shade, which foreign rooms share."""
SYSTEMATIC = 3.5
"""Factor on the predicted deviation of a pose, because errors of neighbouring points of a map are alike. Without it the
errors of 200 starts on a walk are 3.6, of visits beside its path 3.7 times as large as predicted."""


@dataclass(frozen=True)
class Fit:
    """A pose from corners of a render that were found in an image."""

    pose: Pose
    inliers: int
    """Corners that agree with the pose."""
    share: float
    """Of the corners sought, those that agree."""
    sigma: float
    """Predicted standard deviation of the position, in the map's unit: root of the sum over the three axes."""
    sigma_px: float
    """Predicted standard deviation of the pose, as image displacement at the median depth."""


def fit(points: Array, pixels: Array, sought: int, start: Pose, intrinsics: Intrinsics) -> Fit | None:
    """The pose that projects `points` [n, 3] to `pixels` [n, 2] px, from a start; None with too few points.

    `sought` is the number of points that were searched.
    """
    if len(points) < LEAST_POINTS:
        return None
    solved = solve_pose(np.ascontiguousarray(points), np.ascontiguousarray(pixels), intrinsics, start, FIT_SCALES_PX)
    agree = solved.errors_px < AGREES_PX
    inliers = int(agree.sum())
    if inliers < LEAST_POINTS or not np.isfinite(solved.pose.centre).all():
        return None
    noise_px = SYSTEMATIC * median(solved.errors_px[agree]) / RAYLEIGH_MEDIAN
    sigma = noise_px * float(np.sqrt(max(np.trace(np.linalg.inv(solved.hessian)[3:, 3:]), 0.0)))
    return Fit(solved.pose, inliers, inliers / max(sought, 1), sigma, float(noise_px * solved.displacement_px))


@dataclass(frozen=True)
class Found:
    """Points of a map that were found in an image."""

    points: Array
    """[n, 3]"""
    pixels: Array
    """[n, 2] px in the image."""
    sought: int
    """Number of points searched."""


@dataclass(frozen=True)
class Anchor:
    """A render and its corners, which are tracked into images taken near it."""

    view: MapView
    corners: Array
    """[n, 2] px in the render."""
    points: Array
    """[n, 3]"""

    @classmethod
    def at(cls, renderer: MapRenderer, pose: Pose) -> "Anchor":
        """Render a map from a pose."""
        view = renderer.render(pose)
        return cls(view, *view.corners(CORNERS, SPACING_PX))

    def expected(self, pose: Pose) -> tuple[Array, NDArray[np.bool_]]:
        """Where a camera at a pose sees the points, [n, 2] px, and which of them lie in its image, [n]."""
        local = (self.points - pose.centre) @ pose.rotation
        at = self.view.intrinsics.project(local)
        height, width = self.view.depth.shape
        inside = (local[:, 2] > 0) & (at > 4).all(1) & (at[:, 0] < width - 4) & (at[:, 1] < height - 4)
        return at, inside

    def shift_px(self, pose: Pose) -> float:
        """Median motion of the corners from the render to a pose."""
        return median(np.linalg.norm(self.expected(pose)[0] - self.corners, axis=1)) if len(self.corners) else np.inf

    def find(self, levels: Pyramid, guess: Pose, few: int | None) -> Found:
        """The corners found in an image near where `guess` sees them; `few` limits the pyramid's levels."""
        at, inside = self.expected(guess)
        found, good = follow(self.view.levels, levels, self.corners[inside], at[inside], REACH_PX, few)
        return Found(self.points[inside][good], found[good], int(inside.sum()))

    def locate(self, levels: Pyramid, guess: Pose, few: int | None) -> Fit | None:
        """The pose of an image from the corners found near where `guess` sees them."""
        if self.expected(guess)[1].sum() < LEAST_POINTS:
            return None
        found = self.find(levels, guess, few)
        return fit(found.points, found.pixels, found.sought, guess, self.view.intrinsics)


def align(renderer: MapRenderer, levels: Pyramid, start: Pose, rounds: int = ROUNDS) -> tuple[Fit, Anchor] | None:
    """The pose of an image, and the last render, from a start within some ten pixels; None if it is lost on the way."""
    guess, found, anchor = start, None, None
    for turn in range(rounds):
        anchor = Anchor.at(renderer, guess)
        found = anchor.locate(levels, guess, LEVELS if turn == 0 else NEAR_LEVELS)
        if found is None:
            return None
        guess = found.pose
    assert found is not None and anchor is not None
    return found, anchor


def correlation(view: MapView, image: Picture) -> float:
    """Normalised cross-correlation of a render and an image [H, W] where the map has surfaces, of details only."""
    a, b = (details(one) for one in (view.picture, image))
    mask = view.sound
    if mask.sum() < LEAST_POINTS:
        return 0.0
    a, b = a[mask] - a[mask].mean(), b[mask] - b[mask].mean()
    return float((a * b).sum() / max(float(np.sqrt((a * a).sum() * (b * b).sum())), 1e-9))


def details(image: NDArray[np.generic]) -> NDArray[np.float32]:
    """What is left of an image [H, W] without noise, and without light and shade."""
    values = image.astype(np.float32)
    fine, coarse = (cv2.GaussianBlur(values, (0, 0), sigma) for sigma in (BLUR_PX, BAND_PX))
    return np.asarray(fine - coarse, np.float32)
