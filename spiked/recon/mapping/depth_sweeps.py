"""Depth of the views of a path, by plane sweeps against other views."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np

from spiked.pose import Array
from spiked.recon.frontend.windowing import luminance
from spiked.recon.mapping.plane_sweep import PLANE_STEP_PX, SWEPT_PIXELS, PosedImage, Sweep, neighbours, sweep
from spiked.recon.mapping.seeding import Seeding, SweptView
from spiked.recon.view_store import ViewStore
from spiked.render import Camera
from spiked.sensor import LEAST_DEPTH, Image, Intrinsics, Mosaic
from spiked.undistortion import Undistortion, widest_undistortion

SWEPT_SIDES = 2.5
"""Longest side of undistorted images that are swept, in widths of the sensor."""
UNKNOWN_NOISE = 1e6
"""Deviation of pixels outside of the image, in spikes a frame: they weigh nothing."""
FILL_PX, FILL_CELLS = 8, ((1.0, 1.0), (4.0, 0.03), (16.0, 0.001))
"""Cells, in px, in which landmarks fill a depth, and standard deviations in cells with weights of their mean."""
FILL_BASE = 1e-6
"""Weight of the mean of all landmarks, where none is near."""


@dataclass(frozen=True)
class PosedViews:
    """Views by id with their poses, camera to world."""

    ids: list[int]
    rotations: Array
    """[V, 3, 3]"""
    centres: Array
    """[V, 3]"""


@dataclass(frozen=True)
class Effort:
    """How thoroughly a view is swept."""

    pixels: int
    """Pixels of the swept image, about."""
    neighbours: int
    """Views that it is compared with."""
    step_px: float
    """Distance of the planes, in pixels of the swept image."""


THOROUGH = Effort(SWEPT_PIXELS, 5, PLANE_STEP_PX)
QUICK = Effort(SWEPT_PIXELS // 16, 3, 1.2)
"""Of views far apart while a camera is tracked: 25 ms on one core. Landmarks fill the rest."""


@dataclass(frozen=True)
class DepthSweeps:
    """Sweeps views of a camera."""

    camera: Camera
    mosaic: Mosaic | None
    views: ViewStore
    seeding: Seeding

    def prepare(
        self, posed: PosedViews, row: int, points: Array, effort: Effort = THOROUGH, threads: int | None = None
    ) -> Callable[[], SweptView] | None:
        """What sweeps view number `row` of `posed` against the others, on any thread; None if too few points are in
        front of it, or if no other view sees what it sees.

        points [N, 3] are landmarks: their depths give the range of the sweep. Threads default to the usable cores.
        """
        view, intrinsics = self.views.image(posed.ids[row]), self.camera.intrinsics
        rotation, centre = posed.rotations[row], posed.centres[row]
        depths = (points - centre) @ rotation[:, 2]
        planes = self.seeding.planes(depths)
        if planes is None:
            return None

        lens: Undistortion | None = None
        if intrinsics.distortion is not None:  # the sweep's warps are homographies
            lens = widest_undistortion(intrinsics, self.camera.width, self.camera.height, SWEPT_SIDES)

        def shot(at: int) -> PosedImage:
            image = luminance(self.views.image(posed.ids[at]).rate, self.mosaic)
            image = image if lens is None else lens.straighten(image, np.nan)
            return PosedImage(image, posed.rotations[at], posed.centres[at])

        near = neighbours(posed.centres, posed.rotations[:, :, 2], row, effort.neighbours)
        if len(near) == 0:
            return None
        reference, others = shot(row), [shot(at) for at in near]
        noise = self.seeding.noise * view.deviation

        def work() -> SweptView:
            if lens is None:
                swept = sweep(reference, others, intrinsics, planes, noise, effort.pixels, threads, effort.step_px)
            else:
                swept = _sweep_straight(lens, reference, others, planes, noise, effort, threads)
            return SweptView(view, rotation, centre, float(np.median(depths[depths > 0])), swept)

        return work

    def prepare_quick(
        self, posed: PosedViews, row: int, seen: Array, threads: int | None = None
    ) -> Callable[[], SweptView] | None:
        """The same with little effort; the landmarks `seen` [N, 3] in the view fill what it leaves uncertain."""
        work = self.prepare(posed, row, seen, QUICK, threads)
        if work is None:
            return None

        def fill() -> SweptView:
            swept = work()
            local = (seen - swept.centre) @ swept.rotation
            return replace(swept, sweep=_filled(swept.sweep, local, self.camera.intrinsics))

        return fill


def _sweep_straight(
    lens: Undistortion,
    reference: PosedImage,
    others: list[PosedImage],
    planes: tuple[float, float],
    noise: Image,
    effort: Effort,
    threads: int | None,
) -> Sweep:
    """A sweep of undistorted images, bent again. Pixels outside of the reference say nothing."""
    known = np.isfinite(reference.image)
    filled = replace(reference, image=np.where(known, reference.image, np.float32(0)))
    straight = np.where(known, lens.straighten(noise), np.float32(UNKNOWN_NOISE))
    pixels = round(effort.pixels * known.size / noise.size)
    swept = sweep(filled, others, lens.straight, planes, straight, pixels, threads, effort.step_px)
    return Sweep(lens.bend(swept.inverse_depth), lens.bend(np.where(known, swept.confidence, np.float32(0))))


def _filled(swept: Sweep, local: Array, intrinsics: Intrinsics) -> Sweep:
    """A sweep with the depth of points [n, 3] in the camera's frame where it is not confident: their mean by distance
    in the image. Unchanged if none of them is in it."""
    height, width = swept.inverse_depth.shape
    local = local[local[:, 2] > LEAST_DEPTH]
    column, row = np.floor(intrinsics.project(local) / FILL_PX).astype(int).T
    shape = -(-height // FILL_PX), -(-width // FILL_PX)
    inside = (column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0])
    if not inside.any():
        return swept
    cell, inverse = row[inside] * shape[1] + column[inside], 1 / local[inside, 2]
    count = np.bincount(cell, minlength=shape[0] * shape[1]).reshape(shape)
    total = np.bincount(cell, inverse, shape[0] * shape[1]).reshape(shape)
    weights, means = np.full(shape, FILL_BASE), np.full(shape, FILL_BASE * float(inverse.mean()))
    for cells, weight in FILL_CELLS:
        weights += weight * cv2.GaussianBlur(count.astype(float), (0, 0), cells)
        means += weight * cv2.GaussianBlur(total.astype(float), (0, 0), cells)
    filled, share = cv2.resize((means / weights).astype(np.float32), (width, height)), swept.confidence
    return Sweep(share * swept.inverse_depth + (1 - share) * filled, share)
