"""Losses of a rendered view. Each gives a value and its gradient by the rendered image, scaled so that white is 1.

`LossName` is the registry: the names, what each loss compares, and what a view has to record for it.
"""

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Protocol

import cv2
import numpy as np

from spiked.calibration import Calibration
from spiked.recon.frontend.spike_targets import TargetKind
from spiked.recon.frontend.windowing import luminance
from spiked.recon.mapping.pyramid import Target
from spiked.recon.mapping.render_requests import RenderRequest
from spiked.render import Camera, RenderedImage
from spiked.render.charge import ChargeLoss
from spiked.render.loss import StructuralSimilarity
from spiked.sensor import Image, Mosaic

RATE_RANGE = 1e-3, 1 - 1e-3
"""Range of the probabilities of a likelihood: the logarithm of others has no useful gradient."""


class LossName(StrEnum):
    """The losses that a map can be fitted with (docs/paper.md)."""

    CHARGE = "charge"
    """The default: the charge between spikes, weighted by its noise; that of all frames where the motion is fast."""
    ACCUMULATION = "accumulation"
    """Spikes counted in 32 frames against the mean of renders along them (Eq 19 to 24)."""
    INTERVAL = "interval"
    """The interval between two adjacent spikes of each pixel against a render at its middle (Eq 25 to 27)."""
    BINOMIAL = "binomial"
    """Likelihood of the spikes in 16 pixels and 32 frames (Eq 1 to 5)."""
    ACCUMULATION_BINOMIAL = "accumulation+binomial"
    """Both, as Nope-SGS fits its scene."""

    @property
    def target(self) -> TargetKind | None:
        """What views record for it; None: the intervals that they have."""
        if self is LossName.CHARGE:
            return None
        return TargetKind.ADJACENT if self is LossName.INTERVAL else TargetKind.COUNTS


@dataclass(frozen=True)
class Comparison:
    """A rendered image compared with its target."""

    value: float
    """The loss."""
    slope: Image
    """Gradient of the loss by the rendered image, of its shape, in rates."""
    error: float
    """Mean squared error in units of white squared, for reports; weighted by the noise where the loss is."""


class ViewLoss(Protocol):
    """A loss of a view's image."""

    def compare(self, expected: Image, target: Target, white: float, mosaic: Mosaic | None = None) -> Comparison:
        """Compare rates `expected`, [H, W] or [H, W, 3], with a target of their shape."""


def _on_one_thread() -> StructuralSimilarity:
    return StructuralSimilarity(1)


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
    similarity: StructuralSimilarity = field(default_factory=_on_one_thread, compare=False, repr=False)

    def __call__(
        self, expected: Image, target: Target, white: float, mosaic: Mosaic | None = None
    ) -> tuple[float, Image]:
        """`error` and `slope` of `compare`."""
        made = self.compare(expected, target, white, mosaic)
        return made.error, made.slope

    def compare(self, expected: Image, target: Target, white: float, mosaic: Mosaic | None = None) -> Comparison:
        """Compare rates [H, W] or [H, W, 3] with a target of their shape.

        Structural similarity of a `mosaic` is compared in grey, with the same colour mixture at every pixel.
        """
        error = expected - target.values
        weight = self.certainty(target.deviation, white)
        scale = np.float32(1 / (white**2 * error.size))
        squares = Comparison(0.0, 2 * scale * weight * error, float(np.mean(weight * error * error)) / white**2)
        return _with_similarity(self, squares, expected, target, white, mosaic)

    def certainty(self, deviation: Image, white: float) -> Image:
        """Weight in [0, 1] of a squared error of a rate with that standard deviation; 1 for a noiseless pixel."""
        floor = np.float32((self.floor * white) ** 2)
        return np.asarray(floor / (deviation**2 + floor), np.float32)


def _with_similarity(
    loss: "RateLoss | PhotometricLoss",
    squares: Comparison,
    expected: Image,
    target: Target,
    white: float,
    mosaic: Mosaic | None,
) -> Comparison:
    """(1 - share) squared error + share * scale * (1 - SSIM); `squares` has the squared error and its slope."""
    share, scale = loss.ssim, loss.ssim_scale
    if share == 0:
        return Comparison(squares.error, squares.slope, squares.error)
    rendered, seen = luminance(expected, mosaic), luminance(target.values, mosaic)
    unlike, slope = loss.similarity(rendered, seen, white)
    # The filter of `luminance` is symmetric, so it is its own transpose but for the border.
    slope = (1 - share) * squares.slope + share * scale * luminance(slope, mosaic)
    return Comparison((1 - share) * squares.error + share * scale * unlike, slope, squares.error)


@dataclass(frozen=True)
class PhotometricLoss:
    """(1 - l) mean squared error + l (1 - SSIM), every pixel alike: Eq 24 and 27 of the paper.

    The equations have SSIM where they must mean 1 - SSIM. Pixels whose deviation is infinite are left out.
    """

    ssim: float = 0.2
    """Lambda of the equations."""
    ssim_scale: float = 0.01
    """As in `RateLoss`; 1 is what the equations say."""
    similarity: StructuralSimilarity = field(default_factory=_on_one_thread, compare=False, repr=False)

    def compare(self, expected: Image, target: Target, white: float, mosaic: Mosaic | None = None) -> Comparison:
        """See `ViewLoss.compare`."""
        error = np.where(np.isfinite(target.deviation), expected - target.values, np.float32(0))
        slope = np.asarray(2 * error * np.float32(1 / (white**2 * error.size)), np.float32)
        squares = Comparison(0.0, slope, float(np.mean(error * error)) / white**2)
        return _with_similarity(self, squares, expected, target, white, mosaic)


@dataclass(frozen=True)
class BinomialLoss:
    """Negative log likelihood of the spikes of blocks of pixels, over the number of their frames: Eq 1 to 5 pooled.

    A pixel fires in a frame with the probability of its rate p (Bernoulli), so that k of the n frames of a block do by
    a binomial law: -(k log p + (n - k) log(1 - p)) / n, p the mean rate rendered over the block and its frames. The
    least value for these k is subtracted: a perfect map has a loss of 0.
    """

    block_px: int = 4
    """Width of a block in sensor pixels; 16 pixels are pooled."""

    def compare(self, expected: Image, target: Target, white: float, mosaic: Mosaic | None = None) -> Comparison:
        """See `ViewLoss.compare`; pixels of a mosaic are pooled as they are."""
        side = max(1, self.block_px // target.pixel)
        rate = np.clip(_pooled(expected, side), *RATE_RANGE).astype(np.float64)
        fired = np.clip(_pooled(target.values, side), 0, 1).astype(np.float64)
        sure = np.clip(fired, *RATE_RANGE)
        least = -(fired * np.log(sure) + (1 - fired) * np.log(1 - sure))
        likelihood = -(fired * np.log(rate) + (1 - fired) * np.log(1 - rate))
        by_rate = np.asarray((rate - fired) / (rate * (1 - rate)) / (rate.size * side * side), np.float32)
        slope = np.zeros_like(expected)
        height, width = side * rate.shape[0], side * rate.shape[1]
        slope[:height, :width] = by_rate.repeat(side, 0).repeat(side, 1)
        error = float(np.mean((expected - target.values) ** 2)) / white**2
        return Comparison(float(np.mean(likelihood - least)), slope, error)


def _pooled(image: Image, side: int) -> Image:
    """Means of squares of pixels; incomplete ones are left out. [H, W] or [H, W, C]."""
    height, width = image.shape[0] // side, image.shape[1] // side
    squares = image[: height * side, : width * side].reshape(height, side, width, side, -1).mean((1, 3))
    return np.asarray(squares.reshape(height, width, *image.shape[2:]), np.float32)


@dataclass(frozen=True)
class SummedLoss:
    """The photometric loss of the accumulation image and the binomial likelihood of its spikes."""

    photometric: PhotometricLoss = field(default_factory=PhotometricLoss)
    binomial: BinomialLoss = field(default_factory=BinomialLoss)
    binomial_weight: float = 0.1
    """Factor on the likelihood. The supplement does not say it (docs/paper.md)."""

    def compare(self, expected: Image, target: Target, white: float, mosaic: Mosaic | None = None) -> Comparison:
        """See `ViewLoss.compare`."""
        light = self.photometric.compare(expected, target, white, mosaic)
        spikes = self.binomial.compare(expected, target, white, mosaic)
        weight = self.binomial_weight
        return Comparison(
            light.value + weight * spikes.value, light.slope + np.float32(weight) * spikes.slope, light.error
        )


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
        gain, dark = self.light(gain)
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
        slope = charge.slope if pixel > 1 else self._with_detail(charge.slope)
        error = self.error(charge.slope, pixel)
        return ChargeComparison(charge.loss / white**2, slope / np.float32(white**2), error, charge.brightness)

    def light(self, gain: Image) -> tuple[Image, Image | None]:
        """Gains and dark rates of the pixels, for gains of a map: those of the calibration, too."""
        if self.calibration is None:
            return gain, None
        return np.where(self.calibration.dead, 0, gain * self.calibration.gain), self.calibration.dark

    def error(self, slope: Image, pixel: int) -> Image:
        """`ChargeComparison.error` for a slope without detail, of an image with pixels of that size."""
        return slope if pixel == 1 else cv2.blur(slope, (1, pixel))

    def _with_detail(self, slope: Image) -> Image:
        """A gradient [h, w] or [h, w, C] with fine detail amplified, see `detail`."""
        blurred = cv2.GaussianBlur(slope, (0, 0), self.detail_px).reshape(slope.shape)
        return np.asarray(slope + np.float32(self.detail) * (slope - blurred), np.float32)
