"""Which surfaces the views of a map show, how finely, and whether another map has them too."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from spiked.pose import Array
from spiked.recon.frontend.windowing import grey
from spiked.recon.localisation.alignment import details
from spiked.recon.localisation.map_views import OPAQUE
from spiked.recon.mapping.replay import Replay
from spiked.recon.odometry.sparse_map import Pose
from spiked.render import AnyRasteriser, Camera
from spiked.scene import Scene
from spiked.sensor import Image

SAME_SURFACE = 0.15
"""Largest relative difference of depths of one surface: rendered depths of splats are noisy by 10 %."""
LEAST_COMMON = 0.25
"""Share of a view's pixels that both maps must cover for the view to be compared."""


@dataclass(frozen=True)
class Shown:
    """A map as seen from one pose."""

    pose: Pose
    camera: Camera
    replay: Replay

    @classmethod
    def of(cls, rasteriser: AnyRasteriser, camera: Camera, scene: Scene, pose: Pose) -> "Shown":
        """Render a scene."""
        return cls(pose, camera, Replay.of(rasteriser, scene, pose.rotation, pose.centre))

    @property
    def depth(self) -> Image:
        """[H, W]"""
        return self.replay.depth

    @property
    def opaque(self) -> NDArray[np.bool_]:
        """[H, W], where the map has a surface."""
        return self.replay.opacity > OPAQUE


def fineness(views: Sequence[Shown], points: Array) -> NDArray[np.float32]:
    """Pixels a unit of length at which each view shows points [n, 3]; 0 where it does not. [n, views]"""
    out = np.zeros((len(points), len(views)), np.float32)
    square = np.ones((3, 3), np.uint8)
    for number, view in enumerate(views):
        local = (points - view.pose.centre) @ view.pose.rotation
        z = local[:, 2]
        height, width = view.depth.shape
        at = view.camera.intrinsics.project(local)
        inside = (z > 0) & (at >= 0).all(1) & (at[:, 0] < width) & (at[:, 1] < height)
        column, row = at[inside].astype(int).T
        near, far = cv2.erode(view.depth, square)[row, column], cv2.dilate(view.depth, square)[row, column]
        on = view.opaque[row, column] & (z[inside] > near * (1 - SAME_SURFACE))
        on &= z[inside] < far * (1 + SAME_SURFACE)
        rows = np.flatnonzero(inside)[on]
        out[rows, number] = view.camera.intrinsics.fx / z[rows]
    return out


@dataclass(frozen=True)
class Agreement:
    """Two maps compared from one pose of the second."""

    same: float
    """Share of the common pixels at the same depth."""
    correlation: float
    """Of the details there."""
    brightness: float
    """Median radiance of the first over that of the second."""


def compare(first: Shown, second: Shown) -> Agreement | None:
    """Compare renders of two maps in one frame of reference from one pose; None if they have little in common."""
    both = first.opaque & second.opaque
    if both.mean() < LEAST_COMMON:
        return None
    apart = np.abs(np.log(np.maximum(first.depth[both], 1e-9) / np.maximum(second.depth[both], 1e-9)))
    a, b = grey(first.replay.values), grey(second.replay.values)
    fine = [details(np.sqrt(np.maximum(image, 0)))[both] for image in (a, b)]
    fine = [one - one.mean() for one in fine]
    size = np.sqrt(np.prod([float((one * one).sum()) for one in fine]))
    bright = b[both] > 0
    ratio = float(np.median(a[both][bright] / b[both][bright])) if bright.any() else 1.0
    return Agreement(float((apart < SAME_SURFACE).mean()), float((fine[0] * fine[1]).sum() / max(size, 1e-12)), ratio)
