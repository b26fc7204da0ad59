"""Losses of a rendered view. Each gives a value and its gradient by the rendered image, scaled so that white is 1."""

from dataclasses import dataclass

import cv2
import numpy as np

from spiked.calibration import Calibration
from spiked.recon.frontend.windowing import luminance
from spiked.recon.mapping.pyramid import Target
from spiked.recon.mapping.render_requests import RenderRequest
from spiked.render import Camera, RenderedImage
from spiked.render.charge import ChargeLoss
from spiked.render.loss import dssim
from spiked.sensor import Image, Mosaic


@dataclass(frozen=True)
class RateLoss:
    """Squared error of a view's rates, weighted by their noise, and structural similarity."""

    ssim: float = 0.2
    """Share of structural similarity, 0 to 1; the value of 3D Gaussian splatting (Kerbl et al., 2023)."""
    floor: float = 0.03
    """Noise added to each pixel, in units of white: small values give dark pixels more weight. 0.015 and 0.06 gain
    nothing (decision 3)."""
    ssim_scale: float = 0.01
    """Factor on 1 - SSIM; brings it to the size of the mean squared error."""

    def __call__(
        self, expected: Image, target: Target, white: float, mosaic: Mosaic | None = None
    ) -> tuple[float, Image]:
        """Weighted mean squared error and the gradient of the loss by `expected` [H, W] or [H, W, 3], in rates.

        Structural similarity of a `mosaic` is compared in grey, with the same colour mixture at every pixel.
        """
        error = expected - target.values
        weight = self.certainty(target.deviation, white)
        scale = np.float32(1 / (white**2 * error.size))
        slope = 2 * scale * weight * error
        if self.ssim > 0:
            rendered, seen = luminance(expected, mosaic), luminance(target.values, mosaic)
            # The filter of `luminance` is symmetric, so it is its own transpose.
            structural = luminance(dssim(rendered, target=seen, white=white)[1], mosaic)
            slope = (1 - self.ssim) * slope + self.ssim * self.ssim_scale * structural
        return float(np.mean(weight * error * error)) / white**2, slope

    def certainty(self, deviation: Image, white: float) -> Image:
        """Weight in [0, 1] of a squared error of a rate with that standard deviation; 1 for a noiseless pixel."""
        floor = np.float32((self.floor * white) ** 2)
        return np.asarray(floor / (deviation**2 + floor), np.float32)


@dataclass(frozen=True)
class ChargeComparison:
    """Result of `WarpedChargeLoss`."""

    loss: float
    """Weighted mean squared error of a pixel's charge."""
    slope: Image
    """Gradient by the rendered image, of its shape."""
    error: Image
    """Smooth image of the errors, of the same shape, for densification."""
    brightness: float
    """Spikes counted over spikes expected."""


@dataclass(frozen=True)
class WarpedChargeLoss:
    """The charge loss of one render, warped along its motion to the frames around a view of fast motion."""

    kernel: ChargeLoss
    camera: Camera
    """The camera at the sensor's size."""
    calibration: Calibration | None = None
    floor: float = RateLoss.floor
    """As in `RateLoss`."""
    detail: float = 3.0
    """Gain of the gradient's detail finer than `detail_px`: intervals average along the motion. 3 was best on
    garden_fast (docs/decisions/0008-charge-loss-for-fast-motion.md)."""
    detail_px: float = 1.5
    """Standard deviation of the blur that separates detail, in pixels of the image."""

    def __call__(
        self, image: RenderedImage, request: RenderRequest, gain: Image, white: float, *, pixel: int, phase: int
    ) -> ChargeComparison:
        """Compare a render from the pose of `request` with its frames.

        gain [H, W] multiplies the light. `pixel` is the size of the render's pixels; then only every `pixel`-th pair of
        the sensor's rows is compared, from number `phase` on.
        """
        assert request.warp is not None
        moved = request.warp.displacements(self.camera, request.rotations[0], request.centres[0], image.depth)
        dark = None
        if self.calibration is not None:
            gain = np.where(self.calibration.dead, 0, gain * self.calibration.gain)
            dark = self.calibration.dark
        # An image of large pixels needs only a part of the sensor's rows.
        charge = self.kernel(
            image.values,
            request.warp.frames,
            moved,
            gain,
            dark,
            pixel=pixel,
            every=pixel,
            phase=phase,
            floor=self.floor * white,
        )
        error = charge.slope if pixel == 1 else cv2.blur(charge.slope, (1, pixel))
        slope = charge.slope if pixel > 1 else self._with_detail(charge.slope)
        return ChargeComparison(charge.loss / white**2, slope / np.float32(white**2), error, charge.brightness)

    def _with_detail(self, slope: Image) -> Image:
        """A gradient [h, w] or [h, w, C] with fine detail amplified, see `detail`."""
        blurred = cv2.GaussianBlur(slope, (0, 0), self.detail_px).reshape(slope.shape)
        return np.asarray(slope + np.float32(self.detail) * (slope - blurred), np.float32)
