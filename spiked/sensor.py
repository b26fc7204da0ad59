"""What a camera is: geometry, frame layout, orientation, colour mosaic, and pinhole intrinsics."""

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from spiked.errors import ConfigurationError

__all__ = ["BitOrder", "Intrinsics", "Layout", "Mosaic", "Sensor"]

Image = NDArray[np.float32]
"""Upright image [H, W] or [H, W, C] of rates, radiance or what is derived from them, float32."""

LEAST_DEPTH = 1e-6
"""Depth of a point in front of a camera, at least, in units of the scene."""


class Layout(StrEnum):
    """How one frame's bits are stored."""

    COMPACT = "compact"
    """Rows of width / 8 bytes, nothing else (`Flavour` A, D and F in recording/geometry.py)."""
    ROW_TAGGED = "row_tagged"
    """Each row of bits is followed by its u16 little-endian number (`Flavour.B`)."""

    @classmethod
    def _missing_(cls, value: object) -> "Layout | None":
        """`row-tagged` is read as `row_tagged`."""
        name = str(value).replace("-", "_")
        return next((member for member in cls if member.value == name), None)


class BitOrder(StrEnum):
    """Which bit of a byte is the leftmost of its eight pixels."""

    LSB = "lsb"
    MSB = "msb"


class Mosaic(StrEnum):
    """Colour of the sites (0,0) (0,1) (1,0) (1,1) of the upright image, row-major."""

    RGGB = "RGGB"
    BGGR = "BGGR"
    GRBG = "GRBG"
    GBRG = "GBRG"

    def channels(self, height: int, width: int) -> NDArray[np.uint8]:
        """The channel (0 red, 1 green, 2 blue) that each pixel of the upright image sees, uint8 [height, width]."""
        tile = np.array(["RGB".index(letter) for letter in self.value], np.uint8).reshape(2, 2)
        return np.tile(tile, ((height + 1) // 2, (width + 1) // 2))[:height, :width]


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera without distortion; lengths in pixels, the centre of the first pixel is (0.5, 0.5)."""

    fx: float
    fy: float
    cx: float
    cy: float

    @classmethod
    def from_fov(cls, width: int, height: int, horizontal_deg: float) -> "Intrinsics":
        """Square pixels, centred principal point, and the given horizontal field of view in degrees."""
        if not 1.0 <= horizontal_deg <= 170.0:
            raise ConfigurationError(f"field of view {horizontal_deg:g} degrees is outside 1 to 170")
        focal = 0.5 * width / float(np.tan(np.radians(horizontal_deg) / 2))
        return cls(focal, focal, width / 2, height / 2)

    def matrix(self) -> NDArray[np.float64]:
        """K, float64 [3, 3]."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]])

    def scaled(self, factor: float) -> "Intrinsics":
        """The intrinsics of the same image at `factor` times its size."""
        return Intrinsics(self.fx * factor, self.fy * factor, self.cx * factor, self.cy * factor)

    def project(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixels [..., 2] of points [..., 3] in camera axes; a depth below `LEAST_DEPTH` counts as that."""
        slope = points[..., :2] / np.maximum(points[..., 2:], LEAST_DEPTH)
        return np.asarray(slope * [self.fx, self.fy] + [self.cx, self.cy], np.float64)

    def unproject(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Directions [..., 3] with z = 1, in camera axes, of pixels [..., 2]."""
        slope = (pixels - [self.cx, self.cy]) / [self.fx, self.fy]
        return np.concatenate([slope, np.ones((*slope.shape[:-1], 1))], -1)


@dataclass(frozen=True)
class Sensor:
    """Everything needed to turn stored bytes into upright frames, and pixels into rays."""

    width: int
    height: int
    frame_rate_hz: float
    layout: Layout = Layout.COMPACT
    bit_order: BitOrder = BitOrder.LSB
    flipped: bool = True
    """Rows are stored bottom-up."""
    mosaic: Mosaic | None = None
    intrinsics: Intrinsics | None = None

    def __post_init__(self) -> None:
        if self.width <= 0 or self.height <= 0 or self.width % 8:
            raise ConfigurationError(
                f"geometry {self.width}x{self.height} is not possible: sizes are positive and a row is whole bytes, "
                "so the width must be a multiple of 8"
            )
        if not 0 < self.frame_rate_hz < np.inf:
            raise ConfigurationError(f"frame rate {self.frame_rate_hz:g} Hz is not a positive number")

    @property
    def row_bytes(self) -> int:
        """Bytes of pixels in a row."""
        return self.width // 8

    @property
    def row_stride(self) -> int:
        """Bytes from one stored row to the next."""
        return self.row_bytes + (2 if self.layout is Layout.ROW_TAGGED else 0)

    @property
    def frame_bytes(self) -> int:
        """Bytes of one stored frame."""
        return self.row_stride * self.height

    def seconds(self, frame: float) -> float:
        """Time of the start of a frame since frame 0, in seconds; the middle of frame k is `seconds(k + 0.5)`."""
        return frame / self.frame_rate_hz

    def compact(self) -> "Sensor":
        """The same camera with frames stored compactly and LSB first, which is how the ring holds them."""
        return replace(self, layout=Layout.COMPACT, bit_order=BitOrder.LSB)
