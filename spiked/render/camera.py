"""The camera that the renderers see: intrinsics, distortion included, and an image size."""

from dataclasses import dataclass, replace

from spiked.errors import ConfigurationError
from spiked.sensor import Intrinsics

MAX_SIDE = 4096
"""The largest image side, in pixels; tiles are numbered with 16 bits."""


@dataclass(frozen=True)
class Camera:
    """A camera; `intrinsics.pinhole` renders undistorted images."""

    intrinsics: Intrinsics
    width: int
    height: int

    def __post_init__(self) -> None:
        if not (1 <= self.width <= MAX_SIDE and 1 <= self.height <= MAX_SIDE):
            raise ConfigurationError(f"cannot render {self.width}x{self.height}: sides are 1 to {MAX_SIDE} pixels")
        if not (self.intrinsics.fx > 0 and self.intrinsics.fy > 0):
            raise ConfigurationError(
                f"focal lengths {self.intrinsics.fx:g}, {self.intrinsics.fy:g} px are not positive"
            )

    def wider(self, share: float) -> "Camera":
        """The same camera with pictures so many times as wide and high, as far as can be rendered.

        With distortion it is as it is: a lens beyond its own edges is not known.
        """
        optics = self.intrinsics
        if optics.distortion is not None:
            return self
        width, height = (min(round(side * share), MAX_SIDE) for side in (self.width, self.height))
        cx, cy = optics.cx + (width - self.width) / 2, optics.cy + (height - self.height) / 2
        return Camera(replace(optics, cx=cx, cy=cy), width, height)
