"""Options of the map."""

from dataclasses import dataclass, field, replace

from spiked.recon.mapping.densification import DensifyStrategy
from spiked.recon.mapping.loss import (
    BinomialLoss,
    LossName,
    PhotometricLoss,
    RateLoss,
    SummedLoss,
    ViewLoss,
    WarpedChargeLoss,
)
from spiked.recon.mapping.pruning import Pruning
from spiked.recon.mapping.rates import FAST_RATES, RATES, Rates
from spiked.recon.mapping.schedule import Schedule
from spiked.recon.mapping.seeding import Seeding
from spiked.render.loss import StructuralSimilarity

PHOTON_SPLATS = 0.375
"""Splats of a map made of photon counts, over those of one made of spikes (decision 27)."""
PHOTON_FLOOR, PHOTON_BACKGROUND = 0.06, 0.8
"""`MapOptions.floor` and `MapOptions.background` of a map made of photon counts, at least (decision 27)."""


@dataclass(frozen=True)
class MapOptions:
    """How the map is fitted. Lengths are relative to the median depth of the scene, which is 1."""

    stride_px: float = 2.0
    """Spacing of the pixels that become the first splats."""
    splats_a_pixel: float = 0.8
    """Maximum number of splats for each sensor pixel (decision 5)."""
    most_splats: int = 250_000
    """Maximum number of splats in all (decision 8)."""
    extent_px: float = 1000.0
    """Image motion of a path up to which a map has the size above; beyond it splats, seeded views and steps grow in
    proportion. The recordings of docs/accuracy.md move by up to 700 px."""
    rates: Rates = RATES
    """Learning rates of a map whose views mostly see slow motion."""
    fast_rates: Rates = FAST_RATES
    """Those of a map whose views mostly see fast motion."""
    loss: LossName = LossName.CHARGE
    """What the map is fitted to."""
    ssim: float = RateLoss.ssim
    """Share of structural similarity in the loss of rates, see `RateLoss`."""
    ssim_scale: float = RateLoss.ssim_scale
    """Factor on 1 - SSIM, see `RateLoss`."""
    binomial_weight: float = SummedLoss.binomial_weight
    """Factor on the likelihood where it is added to another loss, see `SummedLoss`."""
    sub_frames: int | None = None
    """Sub-frames of straight motion in the render of a view; None follows the motion, 0 renders a still camera."""
    blur_matched: bool = True
    """Each sub-frame is rendered with the blur of its motion and with the time of each pixel; otherwise a view is the
    mean of sharp renders at the middles of its sub-frames, the same for all pixels: Eq 23 of the paper."""
    nuisances: bool = True
    """Estimate each pixel's gain and the brightness of each view (flicker, lamps)."""
    demosaic_first: bool = False
    """Fit a mosaic's map to colours interpolated at every pixel, as most pipelines do, and without nuisances; otherwise
    to the sensor's sites. Only where the map is fitted to windows: `Options.window_frames` chooses them in fast motion,
    too."""
    background: float = 0.5
    """Largest brightness of the random background while fitting, in units of white; 0 is always black (decision 5)."""
    floor: float = RateLoss.floor
    """Noise added to each pixel, in units of white, see `RateLoss`."""
    detail: float = WarpedChargeLoss.detail
    """Gain of fine detail for fast motion, see `WarpedChargeLoss`."""
    seeding: Seeding = field(default_factory=Seeding)
    """How the first splats are made."""
    densification: DensifyStrategy = field(default_factory=DensifyStrategy)
    """Where splats are added later."""
    pruning: Pruning = field(default_factory=Pruning)
    """Which splats are removed."""
    schedule: Schedule = field(default_factory=Schedule)
    """What happens when in a refinement."""

    def rates_of(self, fast: bool) -> Rates:
        """Learning rates for views of slow or of fast motion."""
        return self.fast_rates if fast else self.rates

    def view_loss(self, threads: int | None = 1) -> ViewLoss:
        """The loss of a view's image; `LossName.CHARGE` has another one for fast motion. Threads: None, the cores that
        this process may use."""
        similarity = StructuralSimilarity(threads)
        light = PhotometricLoss(self.ssim, self.ssim_scale, similarity)
        match self.loss:
            case LossName.CHARGE:
                return RateLoss(self.ssim, self.floor, self.ssim_scale, similarity)
            case LossName.ACCUMULATION | LossName.INTERVAL:
                return light
            case LossName.BINOMIAL:
                return BinomialLoss()
            case LossName.ACCUMULATION_BINOMIAL:
                return SummedLoss(light, BinomialLoss(), self.binomial_weight)

    def for_photons(self) -> "MapOptions":
        """Of a single-photon camera: structural similarity with so noisy images would fit their noise, and fewer splats
        leave less of it (decision 27)."""
        return replace(
            self,
            ssim=0.0,
            splats_a_pixel=PHOTON_SPLATS * self.splats_a_pixel,
            floor=max(PHOTON_FLOOR, self.floor),
            background=max(PHOTON_BACKGROUND, self.background),
        )
