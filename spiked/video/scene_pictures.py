"""What a camera sees of a scene on its path."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from spiked.rates import levels
from spiked.render import Camera, rasteriser_for
from spiked.scene import Scene
from spiked.sensor import Intrinsics, Sensor
from spiked.video.camera_path import CameraPath

__all__ = ["scene_pictures", "video_camera"]

WIDTH, FOV_DEG = 1280, 60.0
"""Of a video without a sensor, 16:9."""


def scene_pictures(
    scene: Scene, path: CameraPath, camera: Camera, pictures: int, white: float
) -> Iterator[NDArray[np.uint8]]:
    """Pictures evenly along the path, uint8 [H, W] or RGB [H, W, 3]; `white` is the radiance of 255."""
    rasteriser = rasteriser_for(camera)
    for rotation, centre in zip(*path.sampled(pictures), strict=True):
        image = rasteriser.forward(scene.seen_from(centre), rotation[None], centre[None])
        yield levels(image.values, white)


def video_camera(
    sensor: Sensor | None, width: int | None = None, height: int | None = None, fov_deg: float | None = None
) -> Camera:
    """A camera of the wanted size with the field of view of the sensor, without distortion.

    None: the size of the sensor, or 1280 x 720, and its shape; its field of view, or 60 degrees. Sides are even, as
    H.264 has them.
    """
    w = width or (WIDTH if sensor is None else sensor.width)
    h = height or round(w * 9 / 16 if sensor is None else w * sensor.height / sensor.width)
    w, h = max(2, w - w % 2), max(2, h - h % 2)
    if fov_deg is not None or sensor is None or sensor.intrinsics is None:
        return Camera(Intrinsics.from_fov(w, h, fov_deg or FOV_DEG), w, h)
    k, larger = sensor.intrinsics, w / sensor.width
    cy = h / 2 + larger * (k.cy - sensor.height / 2)
    return Camera(Intrinsics(larger * k.fx, larger * k.fy, larger * k.cx, cy), w, h)
