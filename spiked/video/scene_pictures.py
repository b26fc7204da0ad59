"""What a camera sees of a scene on its path."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from spiked.export.images import levels
from spiked.render import Camera, rasteriser_for
from spiked.scene import Scene
from spiked.video.camera_path import CameraPath

__all__ = ["scene_pictures"]


def scene_pictures(
    scene: Scene, path: CameraPath, camera: Camera, pictures: int, white: float
) -> Iterator[NDArray[np.uint8]]:
    """Pictures evenly along the path, uint8 [H, W] or RGB [H, W, 3]; `white` is the radiance of 255."""
    rasteriser = rasteriser_for(camera)
    for rotation, centre in zip(*path.sampled(pictures), strict=True):
        image = rasteriser.forward(scene.seen_from(centre), rotation[None], centre[None])
        yield levels(image.values, white)
