"""Gradient steps of a map on views: a render is compared with what a view saw, and the map descends.

`map_steps_for` gives the kind that suits the map: where it is on a GPU, neither images nor slopes leave that.
"""

from dataclasses import dataclass

import numpy as np

from spiked.recon.frontend.windowing import View
from spiked.recon.mapping.frame_warp import MIN_RELATIVE_DEPTH
from spiked.recon.mapping.loss import RateLoss, ViewLoss, WarpedChargeLoss
from spiked.recon.mapping.photometric import AGREEING_SIGMAS, MODEL_ERROR, Nuisances
from spiked.recon.mapping.pyramid import Level, Target
from spiked.recon.mapping.render_requests import RenderRequest
from spiked.render.comparison import (
    ChargeTerms,
    DeviceFrame,
    DeviceLight,
    DeviceSpikes,
    FrameCache,
    RateTerms,
    ViewGains,
)
from spiked.render.descent import Descent, DeviceDescent, Stride
from spiked.render.gpu import GpuRasteriser
from spiked.sensor import Image


@dataclass(frozen=True)
class RateStep:
    """A step on the rates of one view."""

    key: int
    """Id of the view: what it saw never changes."""
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


@dataclass(frozen=True)
class ChargeStep:
    """A step on the charge between the spikes of all frames around one view."""

    key: int
    request: RenderRequest
    """With the frames to warp."""
    level: Level
    loss: WarpedChargeLoss
    white: float
    background: float
    phase: int
    """Which rows of the sensor are compared at a smaller size, see `WarpedChargeLoss`."""
    nuisances: Nuisances
    learns: bool = True
    """Whether the step learns of the brightness of the view."""

    def learn(self, brightness: float) -> None:
        """Note by what factor the view was brighter than the render with its nuisances."""
        if self.learns:
            self.nuisances.note(self.key, self.nuisances.level(self.key) * brightness)


class MapSteps:
    """Takes steps on the CPU; rendering and descent may be a GPU's."""

    def __init__(self) -> None:
        self._charge_error: Image = np.zeros((1, 1), np.float32)

    def __getstate__(self) -> dict[str, object]:
        """Nothing: a map that is loaded takes the steps of its machine."""
        return {}

    def fit_rates(self, step: RateStep, descent: Descent, stride: Stride) -> float:
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

    def fit_charge(self, step: ChargeStep, descent: Descent, stride: Stride) -> float:
        """The same; returns the loss of `ChargeComparison`."""
        level, request, gain = step.level, step.request, step.nuisances.factor(step.key)
        poses = request.rotations, request.centres
        image = level.rasteriser.forward(descent.model, *poses, background=step.background)
        made = step.loss(image, request, gain, step.white, pixel=level.factor, phase=step.phase)
        step.learn(made.brightness)
        self._charge_error = made.error
        descent.step(level.rasteriser, made.slope, *stride)
        return made.loss

    @property
    def charge_error(self) -> Image:
        """`ChargeComparison.error` of the last step on charge, [h, w] or [h, w, 3]."""
        return self._charge_error


class DeviceMapSteps(MapSteps):
    """Takes steps on a GPU, where views stay, too. Losses of rates other than `RateLoss`, and the charge through a lens
    with distortion, are the CPU's."""

    def __init__(self) -> None:
        super().__init__()
        self._frames = FrameCache[DeviceFrame]()
        self._spikes = FrameCache[DeviceSpikes]()
        self._light: DeviceLight | None = None
        self._gain: Image | None = None
        """The gains of that."""
        self._last: tuple[ChargeStep, GpuRasteriser] | None = None
        """The last step on charge that was the GPU's."""

    def fit_rates(self, step: RateStep, descent: Descent, stride: Stride) -> float:
        """See `MapSteps.fit_rates`."""
        loss, rasteriser, nuisances = step.loss, step.level.rasteriser, step.nuisances
        if type(loss) is not RateLoss:  # another one may compare more than the kernels do
            return super().fit_rates(step, descent, stride)
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
                nuisances.expect(rasteriser)
                rasteriser.add_evidence(nuisances.level(step.key), MODEL_ERROR)
        return made.error

    def fit_charge(self, step: ChargeStep, descent: Descent, stride: Stride) -> float:
        """See `MapSteps.fit_charge`."""
        loss, rasteriser, request, level = step.loss, step.level.rasteriser, step.request, step.level
        if loss.camera.intrinsics.distortion is not None:
            self._last = None
            return super().fit_charge(step, descent, stride)
        assert isinstance(rasteriser, GpuRasteriser) and isinstance(descent, DeviceDescent)
        assert request.warp is not None
        made = rasteriser.compare_charge(
            descent.on_device(rasteriser),
            request.rotations,
            request.centres,
            self._spikes_of(step, rasteriser),
            self._light_of(step, rasteriser),
            request.warp.motion(loss.camera, request.rotations[0], request.centres[0]),
            ChargeTerms(
                pixel=level.factor,
                phase=step.phase,
                level=step.nuisances.level(step.key),
                floor=loss.floor * step.white,
                white=step.white,
                nearest=MIN_RELATIVE_DEPTH,
                detail=loss.detail if level.factor == 1 else 0.0,
                detail_px=loss.detail_px,
            ),
            step.background,
        )
        descent.step(rasteriser, None, *stride)
        step.learn(made.brightness)
        self._last = step, rasteriser
        return made.loss / step.white**2

    @property
    def charge_error(self) -> Image:
        """See `MapSteps.charge_error`; brought here when it is asked for."""
        if self._last is None:
            return super().charge_error
        step, rasteriser = self._last
        return step.loss.error(rasteriser.charge_slope(), step.level.factor)

    def _frame(self, step: RateStep, rasteriser: GpuRasteriser) -> DeviceFrame:
        """The view of a step, at its size and with the windows of its sub-frames."""

        def make() -> DeviceFrame:
            target, channels = step.target(), None if step.demosaiced else step.level.channels
            return rasteriser.frame(target.values, target.deviation, target.windows, channels)

        return self._frames.get((step.key, step.level.factor, step.request.sub_frames), make)

    def _spikes_of(self, step: ChargeStep, rasteriser: GpuRasteriser) -> DeviceSpikes:
        """Its frames."""
        warp = step.request.warp
        assert warp is not None
        key = step.key, warp.first, len(warp.frames)
        return self._spikes.get(key, lambda: rasteriser.spikes(warp.frames, step.loss.kernel.layout))

    def _light_of(self, step: ChargeStep, rasteriser: GpuRasteriser) -> DeviceLight:
        """The gains of its pixels, and their dark rates."""
        if self._light is None or self._gain is not step.nuisances.gain:
            self._gain = step.nuisances.gain
            self._light = rasteriser.light(*step.loss.light(self._gain))
        return self._light


def map_steps_for(descent: Descent) -> MapSteps:
    """Those of a map that is fitted so."""
    return DeviceMapSteps() if isinstance(descent, DeviceDescent) else MapSteps()
