"""What a camera is: geometry, frame layout, orientation, colour mosaic, and intrinsics with the lens's distortion."""

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from spiked.distortion import Distortion
from spiked.errors import ConfigurationError

__all__ = ["BitOrder", "Intrinsics", "Layout", "Mosaic", "Response", "Sensor"]

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


class Response(StrEnum):
    """How light becomes spikes."""

    INTEGRATE_AND_FIRE = "integrate-and-fire"
    """Charge is gathered from frame to frame; a pixel fires when it reaches a threshold: spike cameras."""
    BERNOULLI = "bernoulli"
    """A pixel fires with p = 1 - exp(-flux), whatever it did before: single-photon cameras. `flux` is the number of
    photons that it is expected to detect in a frame."""


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
    """A pinhole camera behind a lens; lengths in pixels, the centre of the first pixel is (0.5, 0.5)."""

    fx: float
    fy: float
    cx: float
    cy: float
    distortion: Distortion | None = None
    """None: the lens has none."""

    @classmethod
    def from_fov(
        cls, width: int, height: int, horizontal_deg: float, distortion: Distortion | None = None
    ) -> "Intrinsics":
        """Square pixels, centred principal point, and the horizontal field of view in degrees that the lens shows."""
        if not 1.0 <= horizontal_deg <= 170.0:
            raise ConfigurationError(f"field of view {horizontal_deg:g} degrees is outside 1 to 170")
        focal = 0.5 * width / float(np.tan(np.radians(horizontal_deg) / 2))
        if distortion is not None:
            edge = np.array([np.tan(np.radians(horizontal_deg) / 2), 0.0])
            focal = 0.5 * width / float(distortion.bend(edge)[0])
        return cls(focal, focal, width / 2, height / 2, distortion)

    def matrix(self) -> NDArray[np.float64]:
        """K, float64 [3, 3]."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]])

    def scaled(self, factor: float) -> "Intrinsics":
        """The intrinsics of the same image at `factor` times its size."""
        return Intrinsics(self.fx * factor, self.fy * factor, self.cx * factor, self.cy * factor, self.distortion)

    def project(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixels [..., 2] of points [..., 3] in camera axes; a depth below `LEAST_DEPTH` counts as that."""
        slope = points[..., :2] / np.maximum(points[..., 2:], LEAST_DEPTH)
        if self.distortion is not None:
            slope = self.distortion.bend(slope)
        return np.asarray(slope * [self.fx, self.fy] + [self.cx, self.cy], np.float64)

    def unproject(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Directions [..., 3] with z = 1, in camera axes, of pixels [..., 2]."""
        slope = (pixels - [self.cx, self.cy]) / [self.fx, self.fy]
        if self.distortion is not None:
            slope = self.distortion.straighten(slope)
        return np.concatenate([slope, np.ones((*slope.shape[:-1], 1))], -1)

    def by_slope(self, slopes: NDArray[np.float64]) -> NDArray[np.float64]:
        """Derivative [..., 2, 2] of pixels by slopes (x/z, y/z), [..., 2]."""
        focal = np.array([self.fx, self.fy])
        if self.distortion is None:
            return np.broadcast_to(np.diag(focal), (*slopes.shape[:-1], 2, 2))
        return np.asarray(focal[:, None] * self.distortion.derivative(slopes))

    def focal_at(self, pixels: NDArray[np.float64]) -> float | NDArray[np.float64]:
        """Pixels for a slope of 1 near pixels [..., 2]: `fx`, through a lens [...] the mean of both directions."""
        if self.distortion is None:
            return self.fx
        return np.asarray(np.sqrt(np.linalg.det(self.by_slope(self.unproject(pixels)[..., :2]))))

    @property
    def pinhole(self) -> "Intrinsics":
        """The same camera without distortion."""
        return self if self.distortion is None else replace(self, distortion=None)

    def undistorted(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Where `pinhole` sees what this camera sees at pixels [..., 2]; without distortion the same array."""
        return pixels if self.distortion is None else self.pinhole.project(self.unproject(pixels))

    def distorted(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """The inverse of `undistorted`, for pixels [..., 2]."""
        return pixels if self.distortion is None else self.project(self.pinhole.unproject(pixels))

    @property
    def folds(self) -> bool:
        """Whether the distortion turns back before the corner of the image, the centre taken to be its middle."""
        if self.distortion is None:
            return False
        corner = np.hypot(self.cx / self.fx, self.cy / self.fy)
        return bool(np.linalg.norm(self.distortion.bend(np.array([self.distortion.reach, 0.0]))) < corner)

    def lens(self) -> dict[str, NDArray[np.float64]]:
        """Keyword arguments of compiled functions: `lens` [7] as `Distortion.arguments`; none without distortion."""
        return {} if self.distortion is None else {"lens": self.distortion.arguments()}


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
    response: Response = Response.INTEGRATE_AND_FIRE

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
