"""Dense alignment of the whole path with the map: one Gauss-Newton step over all views, in the knots of a spline, or in
the poses of the views where the path is interpolated between them.

Each view is rendered with its depth. The image gradient of the render gives the derivative of each pixel with respect
to the pose (forward-additive direct method) and to the landmark that it sees. The map is as uncertain as its
path, so landmarks are free and marginalised like the points of a bundle adjustment; the tracks' information on
the path is a prior. Basis weights map the blocks of the views to the knots.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

import spiked.native._dense as _dense
from spiked.pose import Array, log_so3
from spiked.recon.frontend.motion_compensation import warp_frames
from spiked.recon.frontend.windowing import View, grey
from spiked.recon.mapping.frame_warp import FrameWarp
from spiked.recon.mapping.mapper import Mapper
from spiked.recon.mapping.pyramid import Level
from spiked.recon.mapping.render_requests import RenderPlanner, RenderRequest
from spiked.recon.statistics import median
from spiked.render.charge import WARP_CELL_PX
from spiked.render.splats import RenderedImage
from spiked.sensor import Image
from spiked.spline import Spline, Waypoints

Index = NDArray[np.int64]
Aligned = TypeVar("Aligned", Spline, Waypoints)

DRIFT_PX = 3.5e-3
"""Error of a long path after 1 px of image motion, in px; it grows with the root of the motion. Three times as much or
a third makes no difference (docs/decisions/0058-long-paths-aligned-with-the-map.md)."""
MIN_ALPHA = 0.9
"""Coverage of the pixels that are compared."""
EDGE_PX = 2
"""Pixels along the border that are left out: their gradients are one-sided."""
MAD_SCALE, ROBUST_SCALES = 1.5, 3.0
"""Standard deviation of normal errors over their median size (1.48, rounded), and the scale of the Cauchy weight in
units of this standard deviation."""


@dataclass(frozen=True)
class AlignmentModel:
    """What an alignment compares, and what holds poses and landmarks before the views do.

    All pixels in a cube of space share a landmark, which is held a little, as few pixels may see it.
    """

    quantile: float
    """Quantile of the gradient magnitude below which pixels are left out."""
    damping: float
    """Damping of each pose, relative to its information."""
    landmark_px: float
    """Approximate width of a landmark in the image."""
    landmark_damping: float
    """Damping, relative to a landmark's own information."""
    landmark_floor: float
    """Damping, relative to the median landmark's information."""


SPLINE_MODEL = AlignmentModel(0.7, 1e-3, 16, 1e-2, 1e-3)
"""Half and twice the width are as good, and poses held by 0.02 are worse (decision 13); landmarks that are hardly held
cost up to 0.4 dB (decision 59)."""
LONG_MODEL = AlignmentModel(0.85, 1e-5, 6, 1e-5, 1e-6)
"""Of a path that is interpolated between views: what holds a spline would hold its bend, which moves every pose and
landmark (decisions 59 and 67)."""


@dataclass(frozen=True)
class TrajectoryPrior:
    """The tracked path and its information matrix, a Gaussian prior for the alignment.

    The path is given by P poses: knots of a spline, or poses at views.
    """

    rotations: Array
    """[P, 3, 3]"""
    centres: Array
    """[P, 3]"""
    information: Array
    """[6 P, 6 P], inverse covariance of (rotation vector on the left, centre)."""

    @classmethod
    def drifting(cls, rotations: Array, centres: Array, moved_px: Array, rad: float, depth: float) -> "TrajectoryPrior":
        """A path whose error is a random walk with the image motion `moved_px` [P - 1] from each pose to the next.

        `rad` is the angle of a pixel, and `depth` that of the scene.
        """
        steps = np.diff(np.eye(len(centres)), axis=0)
        deviation = DRIFT_PX * rad * np.array([1, 1, 1, depth, depth, depth])
        walk = (steps.T / np.maximum(moved_px, 1.0)) @ steps
        return cls(rotations, centres, np.asarray(np.kron(walk, np.diag(1 / deviation**2)), np.float64))

    def gradient(self, rotations: Array, centres: Array) -> Array:
        """Gradient [6 P] of the prior's energy at other poses."""
        turned = log_so3(rotations @ self.rotations.swapaxes(1, 2))
        return np.asarray(self.information @ np.concatenate([turned, centres - self.centres], 1).ravel())


def align(
    path: Aligned,
    times: Sequence[float],
    views: Iterable[tuple[int, View]],
    mapper: Mapper,
    planner: RenderPlanner,
    known: TrajectoryPrior | None = None,
    share: float = 1.0,
) -> Aligned:
    """One Gauss-Newton step of a path towards agreement of the map and views at `times`, given with ids.

    A spline moves by its knots, waypoints by the poses at `times`; `known` is a prior on these. `share` of the step is
    taken.
    """
    pixel = mapper.alignment_level.factor
    model = SPLINE_MODEL if isinstance(path, Spline) else LONG_MODEL
    sums = []
    for (key, view), rotation, centre in zip(views, *path.poses(times), strict=True):
        request = planner.request(view, path, pixel)
        sums.append(_view_normals(key, view, request, rotation, centre, mapper, model))
    variance = float(np.mean([s.variance for s in sums]))
    if not variance:  # no view has a valid pixel
        return path
    square, gradient = (part / variance for part in marginalise_landmarks(sums, model))
    rotations, centres = path.poses(times)
    if isinstance(path, Spline):
        rotations, centres = path.rotations, path.centres
        basis = np.kron(path.basis_matrix(times), np.eye(6))
        square, gradient = basis.T @ square @ basis, gradient @ basis
    if known is not None:
        square, gradient = square + known.information, gradient + known.gradient(rotations, centres)
    diagonal = np.diag(square).copy()
    square[np.diag_indices(len(square))] += model.damping * diagonal + 1e-6 * diagonal.max()
    step = np.asarray(-share * np.linalg.solve(square, gradient).reshape(-1, 6), np.float64)
    if isinstance(path, Spline):
        return path.move(step[:, :3], step[:, 3:])
    return path.bend(times, step[:, :3], step[:, 3:])


@dataclass(frozen=True)
class ViewNormals:
    """Normal equations of one view's pixels, see `photometric_normals`."""

    pose: Array  # [6, 7]
    keys: Index  # [P]
    places: NDArray[np.float32]  # [P, 3, 10]
    variance: float  # of an error


def marginalise_landmarks(sums: list[ViewNormals], model: AlignmentModel) -> tuple[Array, Array]:
    """Hessian [6 V, 6 V] and gradient [6 V] by the poses of V views, all landmarks marginalised (Schur complement)."""
    count = len(sums)
    hessian, gradient = np.zeros((count, 6, count, 6)), np.zeros((count, 6))
    for view, s in enumerate(sums):
        hessian[view, :, view], gradient[view] = s.pose[:, :6], s.pose[:, 6]
    square, right = hessian.reshape(6 * count, 6 * count), gradient.ravel()
    keys, places = [s.keys for s in sums], [s.places for s in sums]
    _dense.marginalise(keys, places, model.landmark_damping, model.landmark_floor, square, right)
    return square, right


def _view_normals(
    key: int, view: View, request: RenderRequest, rotation: Array, centre: Array, mapper: Mapper, model: AlignmentModel
) -> ViewNormals:
    """Normal equations of a view for its pose and the landmarks in view, in units of white."""
    level = mapper.alignment_level
    if request.warp is None:
        image, smooth, seen, certainty = _windowed(key, view, request, mapper, level)
    else:
        image, smooth, seen, certainty = _warped(request, request.warp, mapper, level)
    smooth = smooth / np.float32(mapper.white)
    error = smooth - seen / np.float32(mapper.white)
    du, dv = _slopes(smooth)
    strong = np.zeros(error.shape, bool)
    size = np.hypot(du, dv)
    inside = slice(EDGE_PX, -EDGE_PX)
    strong[inside, inside] = (size > np.quantile(size[::4, ::4], model.quantile))[inside, inside]
    strong &= image.alpha > MIN_ALPHA
    e = error[strong]
    scale = MAD_SCALE * (median(np.abs(e)) if len(e) else 0.0) + 1e-6
    weight = np.where(strong, certainty / (1 + (error / (ROBUST_SCALES * scale)) ** 2), 0).astype(np.float32)
    pose, keys, places = _normals(error, du, dv, image.depth, weight, level, rotation, centre, model.landmark_px)
    variance = float((weight * error**2).sum() / max(float(weight.sum()), 1e-12))
    return ViewNormals(pose, keys, places, variance)


def _slopes(image: Image) -> tuple[Image, Image]:
    """Slopes of an image a pixel to the right and down."""
    return cv2.Scharr(image, cv2.CV_32F, 1, 0, scale=1 / 32), cv2.Scharr(image, cv2.CV_32F, 0, 1, scale=1 / 32)


def _normals(
    error: Image,
    du: Image,
    dv: Image,
    depth: Image,
    weight: Image,
    level: Level,
    rotation: Array,
    centre: Array,
    width_px: float = SPLINE_MODEL.landmark_px,
) -> tuple[Array, Index, NDArray[np.float32]]:
    """Normal equations of the pixels with weight, see `ViewNormals`."""
    count, k = int((weight > 0).sum()), level.camera.intrinsics
    pose, keys, places = np.empty((6, 7)), np.empty(count, np.int64), np.empty((count, 3, 10))
    found = _dense.photometric_normals(
        error,
        du,
        dv,
        depth,
        weight,
        k.fx,
        k.fy,
        k.cx,
        k.cy,
        np.ascontiguousarray(rotation),
        centre,
        width_px / k.fx,
        pose,
        keys,
        places,
        **k.lens(),
    )
    return pose, keys[:found].copy(), places[:found].astype(np.float32)


def pose_curvature(image: RenderedImage, level: Level, white: float, rotation: Array, centre: Array) -> Array:
    """Gauss-Newton Hessian [6, 6] of the mean squared error of a render, in units of white, by its pose: rotation
    vector on the left, then centre. Its landmarks stay where they are."""
    grey_image = level.grey(image.values) / np.float32(white)
    du, dv = _slopes(grey_image)
    weight = np.zeros_like(grey_image)
    inside = slice(EDGE_PX, -EDGE_PX)
    weight[inside, inside] = image.alpha[inside, inside] > MIN_ALPHA
    pose, _, _ = _normals(np.zeros_like(weight), du, dv, image.depth, weight, level, rotation, centre)
    return 2 * pose[:, :6] / weight.size


Compared = tuple[RenderedImage, Image, Image, Image]
"""The render, its grey image [h, w], the observed grey image, and the weight of each squared difference."""


def _windowed(key: int, view: View, request: RenderRequest, mapper: Mapper, level: Level) -> Compared:
    """A view's rates and the map rendered over the pixels' windows."""
    target = level.target(view, request)
    image = level.render(mapper.descent.model, request, target.windows)
    expected = image.values
    if level.factor == 1:
        expected = np.asarray(expected * mapper.nuisances.factor(key), np.float32)
    floor = mapper.options.floor
    certainty = floor**2 / ((level.grey(target.deviation) / mapper.white) ** 2 + floor**2)
    return image, level.grey(expected), level.grey(target.values), certainty


def _warped(request: RenderRequest, warp: FrameWarp, mapper: Mapper, level: Level) -> Compared:
    """The spikes of the frames around a view, warped to it by depth and path, and the map rendered there."""
    image = level.rasteriser.forward(mapper.descent.model, request.rotations, request.centres)
    moved = warp.displacements(mapper.camera, request.rotations[0], request.centres[0], image.depth)
    seen = level.shrunk(warp_frames(warp.frames, mapper.sensor, moved, WARP_CELL_PX))
    return image, grey(image.values), seen, np.ones_like(seen)
