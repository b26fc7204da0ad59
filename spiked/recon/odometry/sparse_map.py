"""The sparse map: tracked views with their poses, and the points triangulated from their tracks."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

import spiked.native._bundle as _bundle
from spiked.pose import Array
from spiked.recon.odometry.bundle_adjustment import Bundle
from spiked.recon.odometry.normal_equations import FreeOptics
from spiked.recon.odometry.self_calibration import EstimatedLens, Focal
from spiked.recon.odometry.stationarity import STILL_PX
from spiked.recon.odometry.tracking_state import State
from spiked.sensor import LEAST_DEPTH, Intrinsics
from spiked.spline import Waypoints

TRIANGULATION_MIN_VIEWS, TRIANGULATION_MIN_SPREAD_PX, TRIANGULATION_MAX_ERROR_PX = 5, 0.5, 2.0
"""Triangulated if seen >= 5 times, ray spread >= 0.5 px, max reprojection error 2 px."""
TRIANGULATION_MIN_FAR_VIEWS = 3
"""The same of views far apart: of a new place a live camera sees few."""
TRIANGULATION_MIN_SPREAD_NOISES = 3.0
"""Ray spread that a triangulation needs, over the noise of the tracks."""
STILL_SHARE = 0.1
"""Share of image motion below `STILL_PX` that counts along the path: most of it is noise of the tracks (decision
15)."""
BORDER_PX = 8
"""Points projected nearer to the image border are not searched."""
MIN_OBSERVATIONS = 3
"""Observations a point needs among the adjusted views."""
MIN_BUNDLE_OBSERVATIONS = 60
"""Observations a bundle adjustment needs in all."""
OUTLIER_NOISES, OUTLIER_PX, OUTLIER_VIEW_SHARE = 6.0, (0.5, 2.0), 0.3
"""A point is dropped if its error exceeds 6 noises, clipped to 0.5 to 2 px, in over 30 % of its views: it moves
(decision 10)."""


class Pose(NamedTuple):
    """Pose of a camera in the world."""

    rotation: Array
    """[3, 3], camera to world."""
    centre: Array
    """[3]"""

    def carried(self, old: "Pose", new: "Pose") -> "Pose":
        """This pose after its neighbourhood moved as from `old` to `new`."""
        turn = new.rotation @ old.rotation.T
        return Pose(turn @ self.rotation, new.centre + turn @ (self.centre - old.centre))


@dataclass(eq=False)
class TrackedView:
    """One view of the tracker: its tracks, its pose and how well both agree."""

    id: int
    """Number of the view in order of tracking: its index in the map's views; never changes."""
    time: float
    """Middle of the window in frames."""
    length: int
    """Frames of the window."""
    ids: NDArray[np.int64]
    """[n] of the tracks in view."""
    pixels: Array
    """[n, 2] px of the tracks at `time`."""
    motion_px: float
    """Median motion of the tracks since the view before."""
    state: State
    """State of the tracker after this view."""
    pose: Pose | None = None
    """None before the bootstrap and while lost."""
    timing_sigma_px: float = 0.0
    """Extra track noise of this view from differing pixel times, see `TrackTimestamps.align`."""
    inliers: float = 0.0
    """Share of the known points within 1.5 px of their projection."""
    chi2: float | None = None
    """Squared median residual over the expected one; 1 if the noise explains it."""
    sigma_px: float | None = None
    """Predicted standard deviation of the pose, as image displacement at the median depth."""
    scale: float = 1.0
    """Lengths around it over those when it got its pose: adjustments and closed loops change them."""

    @property
    def rotation(self) -> Array | None:
        """Of the pose, [3, 3]."""
        return None if self.pose is None else self.pose.rotation

    @property
    def centre(self) -> Array | None:
        """Of the pose, [3]."""
        return None if self.pose is None else self.pose.centre

    @property
    def moved_px(self) -> float:
        """Image motion since the view before, for sums along the path: the noise of a camera that stands still counts
        a tenth."""
        return self.motion_px if self.motion_px > STILL_PX else STILL_SHARE * self.motion_px

    def pixels_of(self, ids: NDArray[np.int64]) -> Array:
        """Positions [n, 2] px of tracks that are in view."""
        order = np.argsort(self.ids)
        return np.asarray(self.pixels[order[np.searchsorted(self.ids, ids, sorter=order)]])


@dataclass(frozen=True)
class MapBundle:
    """A bundle of some views and points of a map."""

    bundle: Bundle
    views: list[TrackedView]
    """[C], all with a pose."""
    ids: NDArray[np.int64]
    """[P] of the points."""

    @property
    def times(self) -> Array:
        """[C] of the views in frames."""
        return np.array([view.time for view in self.views])

    def select(self, observations: NDArray[np.bool_]) -> "MapBundle":
        """With some of the `observations` [M], and the points that these see."""
        left, point = np.unique(self.bundle.point[observations], return_inverse=True)
        bundle = replace(
            self.bundle,
            points=self.bundle.points[left],
            camera=self.bundle.camera[observations],
            point=point,
            pixels=self.bundle.pixels[observations],
        )
        return MapBundle(bundle, self.views, self.ids[left])


@dataclass
class SparseMap:
    """Views in order of time, and the points of their tracks in the same frame of reference."""

    intrinsics: Intrinsics
    focal: Focal | None = None
    """Set where the focal length is estimated: `intrinsics` then follow it."""
    lens: EstimatedLens | None = None
    """Set where a distortion is estimated: `intrinsics` then follow it."""
    lens_known: bool = False
    """No distortion is searched for."""
    views: list[TrackedView] = field(default_factory=list)
    points: Array = field(default_factory=lambda: np.full((0, 3), np.nan))
    """Position of every track by id, NaN where unknown."""
    noise_px: float = 0.0
    """Standard deviation of a track's place in one view and one direction, by the last initialisation or
    adjustment of keyframes or of the whole path."""
    _travelled_px: list[float] = field(default_factory=list)

    @property
    def free_optics(self) -> FreeOptics:
        """What is estimated of `intrinsics`."""
        return FreeOptics(self.focal is not None, self.lens is not None)

    def take_optics(self, bundle: Bundle) -> None:
        """Take over the estimated intrinsics of an adjusted bundle, with the standard deviations of before."""
        self.intrinsics = bundle.intrinsics
        if self.focal is not None:
            self.focal = replace(self.focal, intrinsics=bundle.intrinsics)
        if self.lens is not None:
            self.lens = replace(self.lens, intrinsics=bundle.intrinsics)

    def travelled_px(self, number: int) -> float:
        """Image motion from the first view up to view `number`."""
        for view in self.views[len(self._travelled_px) :]:
            self._travelled_px.append((self._travelled_px[-1] if self._travelled_px else 0.0) + view.moved_px)
        return self._travelled_px[number]

    def reserve(self, tracks: int) -> None:
        """Make room for the points of track ids below `tracks`."""
        if missing := tracks - len(self.points):
            self.points = np.concatenate([self.points, np.full((missing, 3), np.nan)])

    def posed(self) -> list[TrackedView]:
        """The views with a pose."""
        return [view for view in self.views if view.pose is not None]

    def known_tracks(self, view: TrackedView) -> tuple[NDArray[np.int64], Array]:
        """Ids [n] and positions [n, 2] px of a view's tracks whose points are known."""
        known = np.isfinite(self.points[view.ids, 0])
        return view.ids[known], view.pixels[known]

    def project_into(
        self, ids: NDArray[np.int64], pose: Pose, shape: tuple[int, ...]
    ) -> tuple[NDArray[np.bool_], Array]:
        """Which known points [n] lie in the image [H, W] of a view and may be searched there, and where [n, 2] px."""
        local = (self.points[ids] - pose.centre) @ pose.rotation
        at = self.intrinsics.project(local)
        limit = np.array(shape[::-1]) - BORDER_PX
        return (local[:, 2] > LEAST_DEPTH) & (at > BORDER_PX).all(1) & (at < limit).all(1), at

    def errors_px(self, view: TrackedView, pose: Pose) -> Array:
        """Distance [n] of a view's tracks, all of known points, from their projections."""
        local = (self.points[view.ids] - pose.centre) @ pose.rotation
        return np.asarray(np.linalg.norm(self.intrinsics.project(local) - view.pixels, axis=1))

    def triangulate(
        self, views: Sequence[TrackedView], least_views: int = TRIANGULATION_MIN_VIEWS, steps: int = 0
    ) -> None:
        """Triangulate tracks without a point, seen by `least_views`, from those of the views that have a pose: nearest
        to their rays, then by Gauss-Newton `steps` of the reprojection error."""
        posed = [(view, view.pose) for view in views if view.pose is not None]
        if not posed:
            return
        seen = np.repeat(np.arange(len(posed)), [len(view.ids) for view, _ in posed])
        k = self.intrinsics
        _bundle.triangulate(
            np.array([pose.rotation for _, pose in posed]),
            np.array([pose.centre for _, pose in posed]),
            seen,
            np.concatenate([view.ids for view, _ in posed]),
            np.concatenate([view.pixels for view, _ in posed]),
            k.fx,
            k.fy,
            k.cx,
            k.cy,
            least_views,
            max(TRIANGULATION_MIN_SPREAD_PX, TRIANGULATION_MIN_SPREAD_NOISES * self.noise_px),
            TRIANGULATION_MAX_ERROR_PX,
            self.points,
            **k.lens(),
            steps=steps,
        )

    def bundle(self, views: list[TrackedView]) -> MapBundle | None:
        """A bundle of views with a pose and of the points with `MIN_OBSERVATIONS` in them; None if it has too few."""
        ids, pixels = np.concatenate([v.ids for v in views]), np.concatenate([v.pixels for v in views])
        used = (np.bincount(ids, minlength=len(self.points)) >= MIN_OBSERVATIONS) & np.isfinite(self.points[:, 0])
        keep = used[ids]
        if keep.sum() < MIN_BUNDLE_OBSERVATIONS:
            return None
        camera = np.repeat(np.arange(len(views)), [len(v.ids) for v in views])[keep]
        point = (np.cumsum(used) - 1)[ids[keep]]
        poses = [v.pose for v in views if v.pose is not None]
        rotations, centres = np.stack([p.rotation for p in poses]), np.stack([p.centre for p in poses])
        bundle = Bundle(rotations, centres, self.points[used], camera, point, pixels[keep], self.intrinsics)
        return MapBundle(bundle, views, np.flatnonzero(used))

    def apply(self, adjusted: MapBundle) -> None:
        """Take poses and points from an adjusted bundle; drop outlier points, see `OUTLIER_NOISES`."""
        bundle, count = adjusted.bundle, len(adjusted.ids)
        for view, rotation, centre in zip(adjusted.views, bundle.rotations, bundle.centres, strict=True):
            view.pose = Pose(rotation, centre)
        error = np.linalg.norm(bundle.residuals(), axis=1)
        outlier = error > np.clip(OUTLIER_NOISES * bundle.noise_px(), *OUTLIER_PX)
        dropped = np.bincount(bundle.point, outlier, count) > OUTLIER_VIEW_SHARE * np.bincount(
            bundle.point, minlength=count
        )
        self.points[adjusted.ids] = np.where(dropped[:, None], np.nan, bundle.points)

    def rescale(self, unit: float) -> None:
        """Make `unit` the unit of length of points and poses."""
        self.points = self.points / unit
        for view in self.views:
            if view.pose is not None:
                view.pose = Pose(view.pose.rotation, view.pose.centre / unit)

    def waypoints(self, smooth: bool = False) -> Waypoints | None:
        """The path interpolated between views with a pose, see `Waypoints`; None with fewer than two."""
        posed = [(view.time, view.pose) for view in self.views if view.pose is not None]
        if len(posed) < 2:
            return None
        rotations, centres = np.stack([p.rotation for _, p in posed]), np.stack([p.centre for _, p in posed])
        return Waypoints(np.array([time for time, _ in posed]), rotations, centres, smooth)
