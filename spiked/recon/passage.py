"""The frames around a moment of fast motion: where what they saw lies in an image of that moment."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from spiked.native._raster import carry_nodes
from spiked.pose import Array
from spiked.recon.views import Image
from spiked.render import Camera
from spiked.render.charge import CELL_PX

NEAREST = 0.05
"""Depth, relative to the typical one, below which nothing is believed."""


@dataclass(frozen=True)
class Passage:
    """Frames and the camera's way through them, camera-to-world."""

    frames: NDArray[np.uint8]
    """[n, frame_bytes], as stored."""
    rotations: Array
    """[n, 3, 3], at the middle of each frame"""
    centres: Array
    """[n, 3]"""

    def displacements(self, camera: Camera, rotation: Array, centre: Array, depth: Image) -> NDArray[np.float32]:
        """What leads from nodes `CELL_PX` apart in each frame to where the same things are in an image that the
        sensor's `camera` saw from a pose, of `depth` [h, w] (0: nothing there): [n, rows, columns, 2], in its px.

        A place in a frame has, to first order, the depth of where it leads to; two rounds find it.
        """
        columns, rows = -(-camera.width // CELL_PX) + 1, -(-camera.height // CELL_PX) + 1
        inverse, shrink = _smooth_inverse(depth, camera.width)
        k = camera.intrinsics.matrix()
        turn = (k @ rotation.T @ self.rotations @ np.linalg.inv(k)).astype(np.float32)
        shift = ((self.centres - centre) @ rotation @ k.T).astype(np.float32)
        moved = np.empty((len(turn), rows, columns, 2), np.float32)
        carry_nodes(inverse, shrink, turn, np.ascontiguousarray(shift), CELL_PX, NEAREST, moved)
        return moved


def _smooth_inverse(depth: Image, width: int) -> tuple[Image, float]:
    """Inverse depths as means over about a cell, and how many of their pixels go to one of the sensor's."""
    shrink = depth.shape[1] / width
    known = depth > 0
    inverse = 1 / np.maximum(depth, np.float32(NEAREST))
    if not known.all():
        inverse = np.where(known, inverse, np.float32(np.median(inverse[known]) if known.any() else 1.0))
    side = max(1, round(CELL_PX * shrink))
    return np.asarray(cv2.boxFilter(inverse, -1, (side, side), borderType=cv2.BORDER_REPLICATE), np.float32), shrink
