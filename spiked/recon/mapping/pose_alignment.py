"""Dense alignment of the whole path with the map: one Gauss-Newton step over all views, in the knots of the spline.

Each view is rendered with its depth. The image gradient of the render gives the derivative of each pixel with respect
to the pose (forward-additive direct method) and to the landmark that it sees. The map is as uncertain as its
path, so landmarks are free and marginalised like the points of a bundle adjustment; the tracks' information on
the path is a prior. Basis weights map the blocks of the views to the knots.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

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
from spiked.recon.odometry.normal_equations import marginalise
from spiked.recon.statistics import median
from spiked.render.charge import WARP_CELL_PX
from spiked.render.splats import RenderedImage
from spiked.sensor import Image
from spiked.spline import Spline

LANDMARK_PX = 16
"""Approximate width of a landmark in the image: all pixels in its cube of space share its three coordinates. Half and
twice the width are as good (decision 13)."""
LANDMARK_DAMPING, LANDMARK_DAMPING_FLOOR = 1e-2, 1e-3
"""Damping of a landmark, relative to its own information and to the median landmark's: few pixels may see it."""
GRADIENT_QUANTILE = 0.7
"""Quantile of the gradient magnitude below which pixels are left out."""
KNOT_DAMPING = 1e-3
"""Damping of each knot, relative to its information; 0.02 is worse (decision 13)."""
CHUNK_FLOATS = 4_000_000
"""Floats held at once while landmarks are marginalised."""
MIN_ALPHA = 0.9
"""Coverage of the pixels that are compared."""
EDGE_PX = 2
"""Pixels along the border that are left out: their gradients are one-sided."""
MAD_SCALE, ROBUST_SCALES = 1.5, 3.0
"""Standard deviation of normal errors over their median size (1.48, rounded), and the scale of the Cauchy weight in
units of this standard deviation."""


@dataclass(frozen=True)
class TrajectoryPrior:
    """The tracked path and its information matrix, a Gaussian prior for the alignment."""

    spline: Spline
    information: Array
    """[6 knots, 6 knots], inverse covariance of (rotation vector on the left, centre)."""

    def gradient(self, other: Spline) -> Array:
        """Gradient [6 knots] of the prior's energy at another path with the same knots."""
        turned = log_so3(other.rotations @ self.spline.rotations.swapaxes(1, 2))
        apart = np.concatenate([turned, other.centres - self.spline.centres], 1)
        return np.asarray(self.information @ apart.ravel())


def align_spline(
    spline: Spline,
    times: Sequence[float],
    views: Iterable[tuple[int, View]],
    mapper: Mapper,
    planner: RenderPlanner,
    known: TrajectoryPrior | None = None,
    share: float = 1.0,
) -> Spline:
    """One Gauss-Newton step of the spline towards agreement of the map and views at `times`, given with ids.

    `known` is a prior on a spline with the same knots. `share` of the step is taken.
    """
    pixel = mapper.alignment_level.factor
    sums = []
    for (key, view), rotation, centre in zip(views, *spline.poses(times), strict=True):
        sums.append(_view_normals(key, view, planner.request(view, spline, pixel), rotation, centre, mapper))
    square, gradient = marginalise_landmarks(sums, *spline.locate(np.array(times)), len(spline.centres))
    variance = float(np.mean([s.variance for s in sums]))
    if not variance:  # no view has a valid pixel
        return spline
    square, gradient = square / variance, gradient / variance
    if known is not None:
        square, gradient = square + known.information, gradient + known.gradient(spline)
    diagonal = np.diag(square).copy()
    square[np.diag_indices(len(square))] += KNOT_DAMPING * diagonal + 1e-6 * diagonal.max()
    step = np.asarray(-share * np.linalg.solve(square, gradient).reshape(-1, 6), np.float64)
    return spline.move(step[:, :3], step[:, 3:])


@dataclass(frozen=True)
class ViewNormals:
    """Normal equations of one view's pixels, see `photometric_normals`."""

    pose: Array  # [6, 7]
    keys: NDArray[np.int64]  # [P]
    places: Array  # [P, 3, 10]
    variance: float  # of an error


def marginalise_landmarks(
    sums: list[ViewNormals], first: NDArray[np.int64], shares: Array, knots: int
) -> tuple[Array, Array]:
    """Hessian [6 knots, 6 knots] and gradient [6 knots] with all landmarks marginalised (Schur complement).

    The pose of each view blends the knots from `first` [views] on with the weights `shares` [views, degree + 1].
    """
    hessian, gradient = np.zeros((knots, 6, knots, 6)), np.zeros((knots, 6))
    for s, at, share in zip(sums, first, shares, strict=True):
        used = slice(at, at + len(share))
        hessian[used, :, used] += np.einsum("a,ij,b->aibj", share, s.pose[:, :6], share)
        gradient[used] += share[:, None] * s.pose[:, 6]
    square, right = hessian.reshape(6 * knots, 6 * knots), gradient.ravel()
    if not any(len(s.keys) for s in sums):
        return square, right
    names, number = np.unique(np.concatenate([s.keys for s in sums]), return_inverse=True)
    numbers = np.split(number, np.cumsum([len(s.keys) for s in sums])[:-1])
    own = np.zeros((len(names), 3, 4))  # Hessian and gradient of each landmark
    for s, n in zip(sums, numbers, strict=True):
        own[n] += s.places[:, :, [0, 1, 2, 9]]
    trace = np.trace(own[:, :, :3], axis1=1, axis2=2) / 3
    damping = LANDMARK_DAMPING * trace + LANDMARK_DAMPING_FLOOR * median(trace)
    roots = np.linalg.inv(np.linalg.cholesky(own[:, :, :3] + damping[:, None, None] * np.eye(3)))
    chunk = max(1, CHUNK_FLOATS // (18 * knots))
    for begin in range(0, len(names), chunk):
        taken = slice(begin, min(begin + chunk, len(names)))
        cross = np.zeros((taken.stop - begin, 3, knots, 6))
        for s, n, at, share in zip(sums, numbers, first, shares, strict=True):
            here = (n >= begin) & (n < taken.stop)
            cross[n[here] - begin, :, at : at + len(share)] += s.places[here, :, None, 3:9] * share[None, None, :, None]
        eliminated = (roots[taken] @ cross.reshape(len(cross), 3, -1)).reshape(-1, 6 * knots)
        whitened_gradient = (roots[taken] @ own[taken, :, 3:]).ravel()
        square, right = marginalise(square, right, eliminated, whitened_gradient)
    return square, right


def _view_normals(
    key: int, view: View, request: RenderRequest, rotation: Array, centre: Array, mapper: Mapper
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
    strong[inside, inside] = (size > np.quantile(size[::4, ::4], GRADIENT_QUANTILE))[inside, inside]
    strong &= image.alpha > MIN_ALPHA
    e = error[strong]
    scale = MAD_SCALE * (median(np.abs(e)) if len(e) else 0.0) + 1e-6
    weight = np.where(strong, certainty / (1 + (error / (ROBUST_SCALES * scale)) ** 2), 0).astype(np.float32)
    pose, keys, places = _normals(error, du, dv, image.depth, weight, level, rotation, centre)
    variance = float((weight * error**2).sum() / max(float(weight.sum()), 1e-12))
    return ViewNormals(pose, keys, places, variance)


def _slopes(image: Image) -> tuple[Image, Image]:
    """Slopes of an image a pixel to the right and down."""
    return cv2.Scharr(image, cv2.CV_32F, 1, 0, scale=1 / 32), cv2.Scharr(image, cv2.CV_32F, 0, 1, scale=1 / 32)


def _normals(
    error: Image, du: Image, dv: Image, depth: Image, weight: Image, level: Level, rotation: Array, centre: Array
) -> tuple[Array, NDArray[np.int64], Array]:
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
        LANDMARK_PX / k.fx,
        pose,
        keys,
        places,
        **k.lens(),
    )
    return pose, keys[:found], places[:found].copy()


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
    target = level.target(view, request.windows, request.seen)
    image = level.render(mapper.descent.model, replace(request, windows=target.windows))
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
