"""Images without distortion from images with it, and back."""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from spiked.errors import ConfigurationError
from spiked.sensor import Image, Intrinsics

__all__ = ["Undistortion", "straight_camera", "widest_undistortion"]

MARGIN_PX = 2
"""Pixels around an undistorted image that shows all of a distorted one."""
COARSEST = 0.25
"""Smallest pixels of a distorted image over those of an undistorted one, in the middle of the image."""


def straight_camera(
    intrinsics: Intrinsics, width: int, height: int, fineness: float, largest_side: float
) -> tuple[Intrinsics, int, int]:
    """A camera without distortion, its width and its height: it sees all that a camera with distortion sees.

    It has `fineness` pixels for one of the other, along each side, in the middle of the image; fewer where a side would
    be longer than `largest_side`. Raises ConfigurationError where that would be less than `COARSEST`.
    """
    x, y = np.arange(width + 1.0), np.arange(height + 1.0)
    edges = [np.stack(np.broadcast_arrays(x, end), -1) for end in (0.0, float(height))]
    edges += [np.stack(np.broadcast_arrays(end, y), -1) for end in (0.0, float(width))]
    slopes = intrinsics.unproject(np.concatenate(edges))[:, :2]
    low, high = slopes.min(0), slopes.max(0)
    focal = fineness * np.array([intrinsics.fx, intrinsics.fy], np.float64)
    focal *= min(1.0, (largest_side - 2 * MARGIN_PX - 1) / float(((high - low) * focal).max()))
    if focal[0] < COARSEST * intrinsics.fx:
        raise ConfigurationError("the lens sees too wide an angle for one image without distortion")
    centre = MARGIN_PX - low * focal
    across, down = (int(np.ceil(side)) + 2 * MARGIN_PX for side in (high - low) * focal)
    return Intrinsics(float(focal[0]), float(focal[1]), float(centre[0]), float(centre[1])), across, down


@dataclass(frozen=True)
class Undistortion:
    """Resamples images of a camera with distortion as another one without it sees them, and back."""

    bent: Intrinsics
    """Of the camera with distortion."""
    width: int
    height: int
    straight: Intrinsics
    """Of the camera without."""
    straight_width: int
    straight_height: int

    @classmethod
    def of(cls, intrinsics: Intrinsics, width: int, height: int) -> "Undistortion":
        """With the same focal length and centre, and an image of the same size."""
        return cls(intrinsics, width, height, intrinsics.pinhole, width, height)

    @cached_property
    def _to_bent(self) -> NDArray[np.float32]:
        y, x = np.mgrid[0 : self.straight_height, 0 : self.straight_width] + 0.5
        return (self.bent.project(self.straight.unproject(np.stack([x, y], -1))) - 0.5).astype(np.float32)

    @cached_property
    def _to_straight(self) -> NDArray[np.float32]:
        y, x = np.mgrid[0 : self.height, 0 : self.width] + 0.5
        return (self.straight.project(self.bent.unproject(np.stack([x, y], -1))) - 0.5).astype(np.float32)

    def straighten(self, image: Image, fill: float = 0.0) -> Image:
        """An image [H, W] or [H, W, C] without distortion, by bilinear interpolation; `fill` outside."""
        return self._sampled(image, self._to_bent, cv2.BORDER_CONSTANT, fill)

    def bend(self, image: Image) -> Image:
        """An image [h, w] or [h, w, C] with distortion again; pixels outside take the border's values."""
        return self._sampled(image, self._to_straight, cv2.BORDER_REPLICATE)

    @staticmethod
    def _sampled(image: Image, at: NDArray[np.float32], border: int, fill: float = 0.0) -> Image:
        out = cv2.remap(image, at, None, cv2.INTER_LINEAR, borderMode=border, borderValue=(fill,) * 4)
        return np.asarray(out.reshape(*out.shape[:2], *image.shape[2:]))


@lru_cache(maxsize=2)
def widest_undistortion(intrinsics: Intrinsics, width: int, height: int, sides: float) -> Undistortion:
    """Of images that show all that the camera sees; no side of them is longer than `sides` times the width."""
    return Undistortion(intrinsics, width, height, *straight_camera(intrinsics, width, height, 1.0, sides * width))
