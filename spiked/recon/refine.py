"""Dense alignment of the whole path with the map: one Gauss-Newton step over all views, in the knots of the spline.

Each view is rendered with its depth; the image gradient of the render gives how each pixel changes with the pose
(the forward-additive direct method). Basis weights carry the 6x6 blocks of the views to the knots.
"""

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np

from spiked.pose import Array, hat
from spiked.recon.levels import Level
from spiked.recon.mapping import Mapper, Sight
from spiked.recon.motion import carried
from spiked.recon.passage import Passage
from spiked.recon.views import Image, View
from spiked.render.charge import CELL_PX
from spiked.render.splats import Image as Rendered
from spiked.spline import Spline


def align_spline(
    spline: Spline,
    views: list[tuple[int, View]],
    mapper: Mapper,
    sight_of: Callable[[View], Sight],
    share: float = 1.0,
    prior: float = 0.02,
) -> Spline:
    """The spline moved so that the map agrees better with the numbered views, each seen as `sight_of` says.

    `share` of the step is taken; `prior` damps, relative to the diagonal.
    """
    times = np.array([v.time for _, v in views])
    blend = spline.basis_matrix(times)
    rotations, centres = spline.poses(times)
    knots = blend.shape[1]
    hessian, gradient = np.zeros((knots, 6, knots, 6)), np.zeros((knots, 6))
    for (key, view), rotation, centre, row in zip(views, rotations, centres, blend, strict=True):
        h, g = _normal_equations(key, view, sight_of(view), rotation, centre, mapper)
        used = np.flatnonzero(row)
        hessian[np.ix_(used, np.arange(6), used, np.arange(6))] += np.einsum("a,ij,b->aibj", row[used], h, row[used])
        gradient[used] += row[used, None] * g
    square = hessian.reshape(knots * 6, knots * 6)
    diagonal = np.diag(square).copy()
    square[np.diag_indices(knots * 6)] += prior * diagonal + 1e-6 * diagonal.max()
    step = np.asarray(-share * np.linalg.solve(square, gradient.ravel()).reshape(knots, 6), np.float64)
    return spline.move(step[:, :3], step[:, 3:])


def _normal_equations(
    key: int, view: View, sight: Sight, rotation: Array, centre: Array, mapper: Mapper
) -> tuple[Array, Array]:
    """Hessian [6, 6] and gradient [6] of the view's weighted squared error, for (phi, centre) perturbed on the left."""
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
    strong[edge:-edge, edge:-edge] = (size > np.quantile(size[::4, ::4], 0.7))[edge:-edge, edge:-edge]
    strong &= image.alpha > 0.9
    v, u = np.nonzero(strong)
    z = image.depth[v, u].astype(float)
    x = (u + 0.5 - k.cx) / k.fx * z
    y = (v + 0.5 - k.cy) / k.fy * z
    a, b = du[v, u] * k.fx / z, dv[v, u] * k.fy / z
    by_local = np.stack([a, b, -(a * x + b * y) / z], 1)  # change of the pixel with the point in camera axes
    ray = np.stack([x, y, z], 1) @ rotation.T
    # At a fixed pixel a moved camera sees what lay the other way: dI = -grad I . d(pixel of the point).
    by_point = by_local @ rotation.T
    jacobian = -np.concatenate([np.einsum("mj,mjk->mk", by_point, hat(ray)), -by_point], 1)
    e = error[v, u].astype(float)
    scale = 1.5 * np.median(np.abs(e)) + 1e-6
    weight = certainty[v, u] / (1 + (e / (3 * scale)) ** 2)
    weighted = jacobian * weight[:, None]
    return weighted.T @ jacobian, weighted.T @ e


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
