"""Gradient steps on the rates of views: a render is compared with a view, and the map descends.

`rate_steps_for` gives the kind that suits the map: where it is on a GPU, neither images nor slopes leave that.
"""

from dataclasses import dataclass

import numpy as np

from spiked.recon.frontend.windowing import View
from spiked.recon.mapping.loss import RateLoss, ViewLoss
from spiked.recon.mapping.photometric import AGREEING_SIGMAS, MODEL_ERROR, Nuisances
from spiked.recon.mapping.pyramid import Level, Target
from spiked.recon.mapping.render_requests import RenderRequest
from spiked.render.comparison import DeviceFrame, FrameCache, RateTerms, ViewGains
from spiked.render.descent import Descent, DeviceDescent, Stride
from spiked.render.gpu import GpuRasteriser


@dataclass(frozen=True)
class RateStep:
    """A step on one view."""

    key: int
    """Id of the view: its rates never change."""
    view: View
    request: RenderRequest
    level: Level
    """At which size, and by which rasteriser."""
    loss: ViewLoss
    white: float
    background: float
    """Radiance."""
    demosaiced: bool = False
    """Whether a mosaic is compared in colours interpolated at every pixel."""
    nuisances: Nuisances | None = None
    """Of the view's pixels; the step learns of them. None: they are not known."""
    gains: bool = False
    """Whether it learns of the pixels' gains, too, not only of the brightness of the view."""

    def target(self) -> Target:
        """What the render is compared with."""
        target = self.level.target(self.view, self.request)
        return self.level.demosaiced_target(target) if self.demosaiced else target


class RateSteps:
    """Takes steps on the CPU; rendering and descent may be a GPU's."""

    def take(self, step: RateStep, descent: Descent, stride: Stride) -> float:
        """Change the scene of `descent`; returns the error of `Comparison`, before the step."""
        level, target, nuisances, factor = step.level, step.target(), step.nuisances, None
        model, demosaiced = descent.model, step.demosaiced
        expected = level.render(model, step.request, target.windows, step.background, demosaiced=demosaiced).values
        if nuisances is not None:
            factor = nuisances.factor(step.key)
            nuisances.observe(step.key, expected, target.values, target.deviation, step.gains)
            expected = expected * factor
        made = step.loss.compare(expected, target, step.white, None if demosaiced else level.mosaic)
        slope = made.slope if factor is None else np.multiply(made.slope, factor, out=made.slope)
        descent.step(level.rasteriser, slope, *stride)
        return made.error

    def forget_views(self) -> None:
        """Drop what is stored for each view."""


class DeviceRateSteps(RateSteps):
    """Takes steps on a GPU, where views stay, too. Losses other than `RateLoss` are the CPU's."""

    def __init__(self) -> None:
        self._frames = FrameCache()

    def take(self, step: RateStep, descent: Descent, stride: Stride) -> float:
        """See `RateSteps.take`."""
        loss, rasteriser, nuisances = step.loss, step.level.rasteriser, step.nuisances
        if not isinstance(loss, RateLoss):
            return super().take(step, descent, stride)
        assert isinstance(rasteriser, GpuRasteriser) and isinstance(descent, DeviceDescent)
        known = None
        if nuisances is not None:
            known = ViewGains(nuisances.gain, nuisances.level(step.key), MODEL_ERROR, AGREEING_SIGMAS)
        frame = self._frame(step, rasteriser)
        made = rasteriser.compare(
            descent.on_device(rasteriser),
            step.request.rotations,
            step.request.centres,
            frame,
            RateTerms(step.white, loss.floor, loss.ssim, loss.ssim_scale),
            known,
            step.background,
        )
        descent.step(rasteriser, None, *stride)
        if nuisances is not None:
            nuisances.compare(step.key, made.expected_light, made.seen_light)
            if step.gains:
                rasteriser.add_evidence(frame, nuisances.level(step.key), MODEL_ERROR)
                nuisances.expect(rasteriser)
        return made.error

    def forget_views(self) -> None:
        """See `RateSteps.forget_views`."""
        self._frames = FrameCache()

    def _frame(self, step: RateStep, rasteriser: GpuRasteriser) -> DeviceFrame:
        """The view of a step, at its size and with the windows of its sub-frames."""

        def make() -> DeviceFrame:
            target, channels = step.target(), None if step.demosaiced else step.level.channels
            return rasteriser.frame(target.values, target.deviation, target.windows, channels)

        return self._frames.get((step.key, step.level.factor, step.request.sub_frames), make)


def rate_steps_for(descent: Descent) -> RateSteps:
    """Those of a map that is fitted so."""
    return DeviceRateSteps() if isinstance(descent, DeviceDescent) else RateSteps()
