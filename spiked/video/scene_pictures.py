"""What a camera sees of a scene on its path."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from spiked.pose import Array, rotation_of
from spiked.rates import levels
from spiked.render import Camera, rasteriser_for
from spiked.scene import Scene
from spiked.sensor import Intrinsics, Sensor
from spiked.video.camera_path import CameraPath

__all__ = ["scene_pictures", "video_camera"]

WIDTH, FOV_DEG = 1280, 60.0
"""Of a video without a sensor, 16:9."""
LARGEST = 0.26
"""Largest standard deviation of a splat that reaches the camera in a picture beside the recorded path, over the height
of the picture, as the page has it. A renderer draws a splat by its shape at its middle: it would cover all of it."""
REACHES = 1 / 3
"""Standard deviation of such a splat along the depth, over its depth."""


def scene_pictures(
    scene: Scene, path: CameraPath, camera: Camera, pictures: int, white: float, beside: bool = False
) -> Iterator[NDArray[np.uint8]]:
    """Pictures evenly along the path, uint8 [H, W] or RGB [H, W, 3]; `white` is the radiance of 255.

    `beside`: the path may leave the recorded one, so that no splat may fill a picture.
    """
    rasteriser = rasteriser_for(camera)
    for rotation, centre in zip(*path.sampled(pictures), strict=True):
        seen = scene.seen_from(centre)
        if beside:
            seen = _bounded(seen, rotation, centre, camera)
        image = rasteriser.forward(seen, rotation[None], centre[None])
        yield levels(image.values, white)


def _bounded(scene: Scene, rotation: Array, centre: Array, camera: Camera) -> Scene:
    """The scene with splats that reach the camera not larger in the picture than `LARGEST`, along each axis."""
    most, focal = LARGEST * camera.height, camera.intrinsics.fx
    at = (scene.means - centre) @ rotation
    far = np.maximum(at[:, 2], 1e-6)
    slopes = np.linalg.norm(at[:, :2], axis=1) / far
    large = np.flatnonzero((at[:, 2] > 0) & (focal * (1 + slopes) / far * np.exp(scene.log_scales).max(axis=1) > most))
    scales = scene.log_scales.copy()
    for n in large:
        axes = rotation.T @ rotation_of(scene.quats[n]) * np.exp(scales[n])
        if np.linalg.norm(axes[2]) < REACHES * far[n]:
            continue
        lengths = focal / far[n] * np.linalg.norm(axes[:2] - np.outer(at[n, :2] / far[n], axes[2]), axis=0)
        scales[n] -= np.log(np.maximum(lengths / most, 1))
    return replace(scene, log_scales=scales)


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
