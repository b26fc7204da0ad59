"""Dense depth of one view by plane sweep against posed neighbours: the starting geometry of the map.

(R. Collins, "A space-sweep approach to true multi-image matching", CVPR 1996.) Rates are radiometrically consistent
across views, so plain differences in units of their noise are the cost.
"""

from collections import deque
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

import spiked.native._dense as _dense
from spiked.pose import Array
from spiked.render.cpu import usable_cores
from spiked.sensor import Image, Intrinsics

SWEPT_PIXELS = 130_000
"""Images of more than about this many pixels are swept at a smaller size: the first splats are coarser still (decision
5)."""
MAX_COST, OUTSIDE_COST = 4.0, 2.0
"""Cap of a pixel's difference in standard deviations, and its cost outside the other image."""
MAX_TURN_DEG = 25.0
"""Largest angle between the viewing directions of two views that are compared."""
MIN_BASELINE_SHARE = 0.3
"""Shortest baseline of the views compared, over the longest."""
PLANE_STEP_PX, MIN_PLANES, MAX_PLANES = 0.6, 16, 96
"""Disparity between neighbouring planes at the longest baseline, and limits of the number of planes."""
COST_WINDOWS_PX = (3, 9, 21)
"""Windows over which the costs of a plane are averaged; the sum is a peaked kernel."""
RIVAL_DISTANCE = 12
"""A rival of the best plane is at least this part of the planes away."""
SURE_MARGIN = 0.3
"""Margin of the cost of the rival, in units of the cost, that has confidence 1."""
FILL_WINDOWS_PX = (7, 15, 31)
"""Windows from which pixels of low confidence are filled, one after the other."""
MIN_TRUST = 1e-4
"""Weight of a pixel without confidence in its neighbours' means."""


@dataclass(frozen=True)
class PosedImage:
    """An image with its pose (camera-to-world)."""

    image: Image
    rotation: Array
    centre: Array


@dataclass(frozen=True)
class Sweep:
    """`inverse_depth` [H, W] and `confidence` [H, W] in 0..1: margin of the best plane over the best distant one."""

    inverse_depth: Image
    confidence: Image


def neighbours(centres: Array, forward: Array, reference: int, count: int) -> NDArray[np.int64]:
    """Views of suitable baselines to `reference`: spread from `MIN_BASELINE_SHARE` of the widest up.

    centres [V, 3]; forward [V, 3] viewing directions, which exclude views that turned by more than `MAX_TURN_DEG`.
    """
    baseline = np.linalg.norm(centres - centres[reference], axis=1)
    usable = np.flatnonzero((forward @ forward[reference] > np.cos(np.radians(MAX_TURN_DEG))) & (baseline > 1e-9))
    if len(usable) <= count:
        return usable
    ordered = usable[np.argsort(baseline[usable])]
    first = np.searchsorted(baseline[ordered], MIN_BASELINE_SHARE * baseline[ordered[-1]])
    first = min(first, len(ordered) - count)
    return np.asarray(ordered[np.linspace(first, len(ordered) - 1, count).round().astype(int)], np.int64)


def sweep(
    reference: PosedImage,
    others: list[PosedImage],
    intrinsics: Intrinsics,
    near_far: tuple[float, float],
    noise: Image,
    pixels: int = SWEPT_PIXELS,
    threads: int | None = None,
    step_px: float = PLANE_STEP_PX,
) -> Sweep:
    """Inverse depth of `reference` between `near_far` (inverse depths: largest, smallest). `noise` [H, W] is the
    standard deviation of a difference between two images. Images of more than about `pixels` pixels are swept at a
    fraction of their size; planes are `step_px` of these pixels apart. Threads default to the usable cores; the result
    does not depend on their number."""
    height, width = reference.image.shape
    fraction = max(1, round(float(np.sqrt(height * width / pixels))))
    if fraction > 1:
        small = sweep(
            _smaller(reference, fraction),
            [_smaller(other, fraction) for other in others],
            intrinsics.scaled(1 / fraction),
            near_far,
            np.asarray(_shrunk(noise, fraction) / fraction, np.float32),
            height * width,
            threads,
            step_px,
        )
        size = (width, height)
        return Sweep(*(cv2.resize(image, size).astype(np.float32) for image in (small.inverse_depth, small.confidence)))
    k = intrinsics.matrix()
    baseline = max(np.linalg.norm(o.centre - reference.centre) for o in others)
    largest, smallest = near_far
    planes = int(np.clip((largest - smallest) * intrinsics.fx * baseline / step_px, MIN_PLANES, MAX_PLANES))
    inverse = np.linspace(smallest, largest, planes, dtype=np.float32)
    weight = np.ascontiguousarray(1 / np.maximum(noise, 1e-6), np.float32)
    cost = np.empty((planes, height, width), np.float32)
    image = np.ascontiguousarray(reference.image, np.float32)

    def fill(plane: int) -> None:
        total = np.zeros((height, width), np.float32)
        for other in others:
            warped = _through_plane(other, reference, k, float(inverse[plane]))
            _dense.add_cost(warped, image, weight, MAX_COST, OUTSIDE_COST, total)
        total /= len(others)
        near, middle, far = (cv2.boxFilter(total, -1, (size, size)) for size in COST_WINDOWS_PX)
        cost[plane] = near + middle + far

    with ThreadPoolExecutor(threads or usable_cores()) as pool:
        deque(pool.map(fill, range(planes)), maxlen=0)
    return _winner(cost, inverse)


def _smaller(shot: PosedImage, fraction: int) -> PosedImage:
    return PosedImage(_shrunk(shot.image, fraction), shot.rotation, shot.centre)


def _shrunk(image: Image, fraction: int) -> Image:
    """Means of squares of pixels."""
    height, width = image.shape
    shape = (round(width / fraction), round(height / fraction))
    return np.asarray(cv2.resize(image, shape, interpolation=cv2.INTER_AREA), np.float32)


def _through_plane(other: PosedImage, reference: PosedImage, k: Array, inverse_depth: float) -> Image:
    """`other` warped to `reference` through the plane at that inverse depth; NaN outside."""
    rotation = other.rotation.T @ reference.rotation
    shift = other.rotation.T @ (reference.centre - other.centre)
    homography = k @ (rotation + inverse_depth * np.outer(shift, [0.0, 0.0, 1.0])) @ np.linalg.inv(k)
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])  # OpenCV's warp counts pixel centres from 0
    mapping = np.linalg.inv(half) @ homography @ half
    height, width = reference.image.shape
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    warped = cv2.warpPerspective(
        other.image, mapping, (width, height), flags=flags, borderMode=cv2.BORDER_CONSTANT, borderValue=float("nan")
    )
    return np.asarray(warped, np.float32)


def _winner(cost: Image, inverse: Image) -> Sweep:
    """Best plane with parabolic refinement; confidence from the margin to the second best."""
    planes, height, width = cost.shape
    place, margin = np.empty((height, width), np.float32), np.empty((height, width), np.float32)
    _dense.best_plane(cost, max(2, planes // RIVAL_DISTANCE), place, margin)
    confidence = np.clip(margin / SURE_MARGIN, 0, 1).astype(np.float32)
    value = inverse[0] + place * (inverse[1] - inverse[0])
    return Sweep(_settled(value, confidence), confidence)


def _settled(value: Image, confidence: Image) -> Image:
    """Pixels of low confidence take the weighted mean of growing neighbourhoods."""
    trust = confidence**2 + MIN_TRUST
    out = np.asarray(cv2.medianBlur(value, 5), np.float32)
    for size in FILL_WINDOWS_PX:
        mean = cv2.boxFilter(out * trust, -1, (size, size)) / cv2.boxFilter(trust, -1, (size, size))
        out = confidence * out + (1 - confidence) * mean
    return np.asarray(out, np.float32)
