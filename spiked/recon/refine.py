"""Dense alignment of the whole path with the map: one Gauss-Newton step over all views, in the knots of the spline.

Each view is rendered with its depth; the image gradient of the render gives how each pixel changes with the pose
(the forward-additive direct method) and with the place that it sees. The map is as uncertain as the path that drew it,
so its places may move, and are taken out of the equations like the points of a bundle; what tracks knew of the path
counts beside what pixels say. Basis weights carry the blocks of the views to the knots.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

import spiked.native._odometry as _odometry
from spiked.pose import Array, log_so3
from spiked.recon.levels import Level
from spiked.recon.mapping import Mapper, Sight
from spiked.recon.motion import carried
from spiked.recon.passage import Passage
from spiked.recon.robust import median
from spiked.recon.views import Image, View
from spiked.render.charge import CELL_PX
from spiked.render.splats import Image as Rendered
from spiked.spline import Spline

PLACE_PX = 16
"""About how wide the places are that move as one."""
HELD, BARELY_HELD = 1e-2, 1e-3
"""Each place is held by this part of what pixels say of it, and this of what they say of a typical one: else those that
few pixels see would go anywhere."""
STRONG = 0.7
"""Pixels whose slope is below this quantile of all say little, and are left out."""
DAMPING = 1e-3
"""Of each knot, relative to what is known of it."""
CHUNK = 4_000_000
"""Numbers held at once while places are taken out."""


@dataclass(frozen=True)
class Known:
    """A path, and how firmly it is known."""

    spline: Spline
    information: Array
    """[6 knots, 6 knots], inverse covariance of (rotation vector on the left, centre)."""

    def gradient(self, other: Spline) -> Array:
        """Of half the squared distance to another path with the same knots, [6 knots]."""
        turned = log_so3(other.rotations @ self.spline.rotations.swapaxes(1, 2))
        apart = np.concatenate([turned, other.centres - self.spline.centres], 1)
        return np.asarray(self.information @ apart.ravel())


def align_spline(
    spline: Spline,
    views: list[tuple[int, View]],
    mapper: Mapper,
    sight_of: Callable[[View], Sight],
    known: Known | None = None,
    share: float = 1.0,
) -> Spline:
    """The spline moved so that the map, whose places may give way, agrees better with the numbered views, each seen as
    `sight_of` says, and so does what was `known` of a spline with the same knots. `share` of the step is taken."""
    times = np.array([v.time for _, v in views])
    poses = zip(views, *spline.poses(times), strict=True)
    sums = [_look(key, view, sight_of(view), rotation, centre, mapper) for (key, view), rotation, centre in poses]
    square, gradient = without_places(sums, *spline.locate(times), len(spline.centres))
    variance = float(np.mean([s.variance for s in sums]))
    if not variance:  # no view shows anything
        return spline
    square, gradient = square / variance, gradient / variance
    if known is not None:
        square, gradient = square + known.information, gradient + known.gradient(spline)
    diagonal = np.diag(square).copy()
    square[np.diag_indices(len(square))] += DAMPING * diagonal + 1e-6 * diagonal.max()
    step = np.asarray(-share * np.linalg.solve(square, gradient).reshape(-1, 6), np.float64)
    return spline.move(step[:, :3], step[:, 3:])


@dataclass(frozen=True)
class Sums:
    """What the pixels of one view say, see `sum_pixels`."""

    pose: Array  # [6, 7]
    keys: NDArray[np.int64]  # [P]
    places: Array  # [P, 3, 10]
    variance: float  # of an error


def without_places(sums: list[Sums], first: NDArray[np.int64], shares: Array, knots: int) -> tuple[Array, Array]:
    """Hessian [6 knots, 6 knots] and gradient [6 knots] with all places taken out (Schur complement), for views made of
    the knots from `first` [views] on with `shares` [views, degree + 1]."""
    hessian, gradient = np.zeros((knots, 6, knots, 6)), np.zeros((knots, 6))
    for s, at, share in zip(sums, first, shares, strict=True):
        used = slice(at, at + len(share))
        hessian[used, :, used] += np.einsum("a,ij,b->aibj", share, s.pose[:, :6], share)
        gradient[used] += share[:, None] * s.pose[:, 6]
    square, pull = hessian.reshape(6 * knots, 6 * knots), gradient.ravel()
    if not any(len(s.keys) for s in sums):
        return square, pull
    names, number = np.unique(np.concatenate([s.keys for s in sums]), return_inverse=True)
    numbers = np.split(number, np.cumsum([len(s.keys) for s in sums])[:-1])
    own = np.zeros((len(names), 3, 4))  # Hessian and gradient of each place
    for s, n in zip(sums, numbers, strict=True):
        own[n] += s.places[:, :, [0, 1, 2, 9]]
    trace = np.trace(own[:, :, :3], axis1=1, axis2=2) / 3
    held = HELD * trace + BARELY_HELD * median(trace)
    roots = np.linalg.inv(np.linalg.cholesky(own[:, :, :3] + held[:, None, None] * np.eye(3)))
    chunk = max(1, CHUNK // (18 * knots))
    for begin in range(0, len(names), chunk):
        taken = slice(begin, min(begin + chunk, len(names)))
        cross = np.zeros((taken.stop - begin, 3, knots, 6))
        for s, n, at, share in zip(sums, numbers, first, shares, strict=True):
            here = (n >= begin) & (n < taken.stop)
            cross[n[here] - begin, :, at : at + len(share)] += s.places[here, :, None, 3:9] * share[None, None, :, None]
        side = (roots[taken] @ cross.reshape(len(cross), 3, -1)).reshape(-1, 6 * knots)
        square -= side.T @ side
        pull -= side.T @ (roots[taken] @ own[taken, :, 3:]).ravel()
    return square, pull


def _look(key: int, view: View, sight: Sight, rotation: Array, centre: Array, mapper: Mapper) -> Sums:
    """What a view says of its pose and of the places that it sees, in units of white."""
    level = mapper.alignment_level
    if sight.passage is None:
        image, smooth, seen, certainty = _windowed(key, view, sight, mapper, level)
    else:
        image, smooth, seen, certainty = _carried(sight, sight.passage, mapper, level)
    smooth = smooth / np.float32(mapper.white)
    error = smooth - seen / np.float32(mapper.white)
    k = level.camera.intrinsics
    du = cv2.Scharr(smooth, cv2.CV_32F, 1, 0, scale=1 / 32)
    dv = cv2.Scharr(smooth, cv2.CV_32F, 0, 1, scale=1 / 32)
    edge = 2
    strong = np.zeros(error.shape, bool)
    size = np.hypot(du, dv)
    strong[edge:-edge, edge:-edge] = (size > np.quantile(size[::4, ::4], STRONG))[edge:-edge, edge:-edge]
    strong &= image.alpha > 0.9
    e = error[strong]
    scale = 1.5 * (median(np.abs(e)) if len(e) else 0.0) + 1e-6
    weight = np.where(strong, certainty / (1 + (error / (3 * scale)) ** 2), 0).astype(np.float32)
    pose, keys, places = np.empty((6, 7)), np.empty(len(e), np.int64), np.empty((len(e), 3, 10))
    count = _odometry.sum_pixels(
        error,
        du,
        dv,
        image.depth,
        weight,
        k.fx,
        k.fy,
        k.cx,
        k.cy,
        np.ascontiguousarray(rotation),
        centre,
        PLACE_PX / k.fx,
        pose,
        keys,
        places,
    )
    variance = float((weight * error**2).sum() / max(float(weight.sum()), 1e-12))
    return Sums(pose, keys[:count], places[:count].copy(), variance)


Compared = tuple[Rendered, Image, Image, Image]
"""The render, its grey image, what was seen [h, w] alike, and the weight of each pixel's squared difference."""


def _windowed(key: int, view: View, sight: Sight, mapper: Mapper, level: Level) -> Compared:
    """A view's rates, and the map over the pixels' windows."""
    target = level.target(view, sight.windows, sight.seen)
    image = mapper.look(replace(sight, windows=target.windows), level)
    expected = image.values
    if level.factor == 1:
        expected = np.asarray(expected * mapper.nuisances.factor(key), np.float32)
    floor = mapper.options.floor
    certainty = floor**2 / ((level.grey(target.deviation) / mapper.white) ** 2 + floor**2)
    return image, level.grey(expected), level.grey(target.values), certainty


def _carried(sight: Sight, passage: Passage, mapper: Mapper, level: Level) -> Compared:
    """The spikes of the frames around a moment, carried to it by the map's depth and the path, and the map then."""
    image = level.rasteriser.forward(mapper.scene, sight.rotations, sight.centres)
    moved = passage.displacements(mapper.camera, sight.rotations[0], sight.centres[0], image.depth)
    seen = level.shrunk(carried(passage.frames, mapper.sensor, moved, CELL_PX))
    return image, level.mixed(image.values), seen, np.ones_like(seen)
