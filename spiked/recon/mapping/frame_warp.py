"""Warps the frames around a view of fast motion into one rendered image of that view."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from spiked.native._charge import warp_nodes
from spiked.pose import Array
from spiked.render import Camera
from spiked.render.charge import WARP_CELL_PX
from spiked.sensor import Image

MIN_RELATIVE_DEPTH = 0.05
"""Smallest depth, relative to the typical one; nearer depths are clipped."""


@dataclass(frozen=True)
class FrameWarp:
    """Frames with their poses, camera to world."""

    frames: NDArray[np.uint8]
    """[n, frame_bytes], as stored."""
    rotations: Array
    """[n, 3, 3], at the middle of each frame"""
    centres: Array
    """[n, 3]"""
    first: int = 0
    """Absolute number of the first frame."""

    def motion(self, camera: Camera, rotation: Array, centre: Array) -> tuple[Image, Image]:
        """Turns [n, 3, 3] and shifts [n, 3] from pixels p of the frames to those of an image by `camera` from a pose,
        p' ~ turn p + shift / depth, without distortion."""
        k = camera.intrinsics.matrix()
        turn = (k @ rotation.T @ self.rotations @ np.linalg.inv(k)).astype(np.float32)
        return turn, np.ascontiguousarray(((self.centres - centre) @ rotation @ k.T).astype(np.float32))

    def displacements(self, camera: Camera, rotation: Array, centre: Array, depth: Image) -> NDArray[np.float32]:
        """Displacements from nodes `WARP_CELL_PX` apart in each frame to an image rendered by `camera` from a pose.

        depth [h, w] is that of the image, 0 where it is empty. Returns [n, rows, columns, 2] px. The depth of a node
        is that of its end point, found by two fixed-point iterations.
        """
        columns, rows = -(-camera.width // WARP_CELL_PX) + 1, -(-camera.height // WARP_CELL_PX) + 1
        inverse, shrink = _smooth_inverse(depth, camera.width)
        turn, shift = self.motion(camera, rotation, centre)
        moved = np.empty((len(turn), rows, columns, 2), np.float32)
        warp_nodes(inverse, shrink, turn, shift, WARP_CELL_PX, MIN_RELATIVE_DEPTH, moved, **_lens(camera))
        return moved


def _lens(camera: Camera) -> dict[str, NDArray[np.float64] | NDArray[np.float32]]:
    """What the warp needs to know of a lens with distortion: its camera, and where a camera without sees the nodes."""
    k = camera.intrinsics
    if k.distortion is None:
        return {}
    rows, columns = np.mgrid[
        0 : camera.height + WARP_CELL_PX : WARP_CELL_PX, 0 : camera.width + WARP_CELL_PX : WARP_CELL_PX
    ]
    straight = k.undistorted(np.stack([columns, rows], -1).astype(np.float64)).astype(np.float32)
    return {**k.lens(), "camera": np.array([k.fx, k.fy, k.cx, k.cy]), "straight": straight}


def _smooth_inverse(depth: Image, width: int) -> tuple[Image, float]:
    """Inverse depths averaged over about a cell, and the image's width over the sensor's."""
    shrink = depth.shape[1] / width
    known = depth > 0
    inverse = 1 / np.maximum(depth, np.float32(MIN_RELATIVE_DEPTH))
    if not known.all():
        inverse = np.where(known, inverse, np.float32(np.median(inverse[known]) if known.any() else 1.0))
    side = max(1, round(WARP_CELL_PX * shrink))
    return np.asarray(cv2.boxFilter(inverse, -1, (side, side), borderType=cv2.BORDER_REPLICATE), np.float32), shrink
