"""Renders of a map, with the 3D points of their pixels."""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from spiked.pose import Array
from spiked.recon.frontend.feature_tracks import LEVELS, Picture, Pyramid, find_corners, picture, pyramid, white_of
from spiked.recon.frontend.windowing import grey
from spiked.recon.odometry.sparse_map import Pose
from spiked.render import Camera, rasteriser_for
from spiked.scene import Scene
from spiked.sensor import Image, Intrinsics

OPAQUE = 0.8
"""Least opacity of the pixels around a point of the map: what the map never saw is black, and edges of it are none."""
AROUND_PX = 5
"""Side of the square that must be opaque and of one surface."""
STEP = 0.5
"""Largest relative step of depth in that square: where surfaces meet, the rendered depth is of neither."""
BORDER_PX = 6
"""Points nearer to the border are not used."""


@dataclass(frozen=True)
class MapView:
    """The map as seen from a pose."""

    pose: Pose
    intrinsics: Intrinsics
    picture: Picture
    """[H, W] as `feature_tracks.picture`."""
    depth: Image
    """[H, W] in the map's unit."""
    sound: NDArray[np.bool_]
    """[H, W], True where the depth is that of one opaque surface."""

    @cached_property
    def levels(self) -> Pyramid:
        """The picture's pyramid."""
        return pyramid(self.picture, LEVELS)

    def points(self, pixels: Array) -> tuple[Array, NDArray[np.bool_]]:
        """World positions [n, 3] of pixels [n, 2], and which of them are on one opaque surface."""
        height, width = self.depth.shape
        x = np.clip(pixels[:, 0].astype(int), 0, width - 1)
        y = np.clip(pixels[:, 1].astype(int), 0, height - 1)
        local = self.intrinsics.unproject(pixels) * self.depth[y, x, None]
        return self.pose.centre + local @ self.pose.rotation.T, self.sound[y, x]

    def corners(self, count: int, spacing_px: float) -> tuple[Array, Array]:
        """Corners [n, 2] px of the picture on sound pixels, `spacing_px` apart, and their points [n, 3]."""
        pixels = find_corners(self.picture, count, spacing_px, mask=self.sound.astype(np.uint8))
        return pixels, self.points(pixels)[0]


class MapRenderer:
    """Renders a scene for one camera."""

    def __init__(self, scene: Scene, camera: Camera, threads: int | None = None) -> None:
        self.scene, self.camera = scene, camera
        self._rasteriser = rasteriser_for(camera, threads)

    def render(self, pose: Pose) -> MapView:
        """The map from a pose."""
        shown = self._rasteriser.forward(self.scene, pose.rotation[None], pose.centre[None])
        values = grey(shown.values)
        square = np.ones((AROUND_PX, AROUND_PX), np.uint8)
        low, high = cv2.erode(shown.depth, square), cv2.dilate(shown.depth, square)
        sound = (cv2.erode(shown.alpha, square) > OPAQUE) & (high - low < STEP * high)
        sound[:BORDER_PX], sound[-BORDER_PX:], sound[:, :BORDER_PX], sound[:, -BORDER_PX:] = False, False, False, False
        depth = cv2.medianBlur(shown.depth, AROUND_PX)
        return MapView(pose, self.camera.intrinsics, picture(values, white_of(values)), depth, sound)
