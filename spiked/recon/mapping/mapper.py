"""The map: Gaussian splats fitted to views by gradient descent."""

from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import NDArray

from spiked.calibration import Calibration
from spiked.pose import Array
from spiked.recon.frontend.demosaic import fill_mosaic
from spiked.recon.frontend.windowing import View
from spiked.recon.mapping.carrying import Homes, Places
from spiked.recon.mapping.loss import RateLoss, WarpedChargeLoss
from spiked.recon.mapping.map_steps import ChargeStep, RateStep, map_steps_for
from spiked.recon.mapping.options import MapOptions
from spiked.recon.mapping.photometric import Nuisances
from spiked.recon.mapping.pyramid import Level, levels
from spiked.recon.mapping.render_requests import RenderRequest
from spiked.recon.mapping.replay import Replay
from spiked.recon.mapping.seeding import SweptView, isotropic_splats
from spiked.recon.statistics import WHITE_PERCENTILE
from spiked.render import AnyRasteriser, Camera
from spiked.render.charge import ChargeLoss
from spiked.render.descent import Stride, descent_for
from spiked.render.splats import SizeLimits
from spiked.scene import Scene
from spiked.sensor import Image, Sensor

LARGE_PIXELS = 130_000
"""Images of more pixels are aligned at half their size."""
BETAS = 0.9, 0.99
"""Adam's decay rates (10 and 100 steps, decision 3), counted in the steps in which a splat is visible: many splats see
few."""
NUISANCES_FROM = 50
"""Steps before view brightness is estimated: the map has to converge roughly first (decision 5)."""
GAINS_FROM = 500
"""Steps before pixel gains are estimated: earlier they absorb errors of the geometry (decisions 13 and
65)."""
BRIGHTER = 1.05
"""Step by which a map's white rises: each changes the colours of all splats that a page has."""
NOISE_PX = 3, 3
"""Pixels of one colour over whose mean a view's white is taken."""
NUISANCE_STEPS = 100
"""Steps between estimates of the pixel gains."""


class Mapper:
    """Holds the scene and fits it, one view a step. Views are known by their ids."""

    def __init__(
        self,
        sensor: Sensor,
        camera: Camera,
        options: MapOptions,
        seed: int,
        threads: int | None = None,
        calibration: Calibration | None = None,
    ) -> None:
        self.options = options
        self.camera = camera
        self.sensor = sensor
        self.colours = 1 if sensor.mosaic is None else 3
        self.levels = levels(sensor, camera, threads)
        self.channels = self.levels[0].channels
        self.descent = descent_for(Scene.empty(self.colours), *BETAS, threads)
        self.map_steps = map_steps_for(self.descent)
        self.white = 1.0
        """The radiance (spikes a frame) in whose units losses and rates are: `WHITE_PERCENTILE` of the first seeded
        view."""
        self.shown_white = 1.0
        """The radiance that should be shown as white, of the brightest seeded view, in steps of `BRIGHTER`: viewers cut
        off what is brighter."""
        self.depth = 1.0
        """Typical depth of the scene."""
        self.fast = False
        """Whether most views see fast motion."""
        self.nuisances = Nuisances(sensor.height, sensor.width)
        self.rate_loss = RateLoss(options.ssim, options.floor)
        self.view_loss = options.view_loss(threads)
        kernel = ChargeLoss(sensor, threads)
        self.charge_loss = WarpedChargeLoss(kernel, camera, calibration, options.floor, options.detail)
        self.extent = 1.0
        """Size of the map in units of that of a short path, see `MapOptions.extent_px`."""
        self.steps = 0
        self.homes = Homes()
        self._most_log_scale = np.inf
        self._rng = np.random.default_rng(seed)
        self._losses: dict[int, float] = {}

    def __setstate__(self, state: dict[str, object]) -> None:
        vars(self).update(state)
        self.descent = self.descent.moved()
        self.map_steps = map_steps_for(self.descent)

    def __len__(self) -> int:
        """The number of splats."""
        return len(self.descent.model)

    @property
    def scene(self) -> Scene:
        """The map."""
        return self.descent.scene

    @property
    def rasteriser(self) -> AnyRasteriser:
        """Of the sensor's size."""
        return self.levels[0].rasteriser

    @property
    def cap(self) -> int:
        """Maximum number of splats."""
        return self.cap_of(self.extent)

    def cap_of(self, extent: float) -> int:
        """Maximum number of splats of a map of that size."""
        share = self.options.splats_a_pixel * self.camera.width * self.camera.height
        return min(int(share * extent), self.options.most_splats)

    def seed(self, swept: SweptView, surer: float = 0.0) -> int:
        """Add splats at the pixels of a swept view that the map does not cover, with a depth confidence of at least
        `surer`; returns their number."""
        rate, seeding = swept.view.rate, self.options.seeding
        if len(self):
            alpha = self.rasteriser.forward(self.scene, swept.rotation[None], swept.centre[None]).alpha
            empty = alpha < seeding.opacity
        else:
            empty = np.ones(rate.shape, bool)
        self._adapt_white(rate)
        empty &= swept.sweep.confidence >= surer
        stride = seeding.stride(rate.size, int(self.cap / self.extent), self.options.stride_px)
        chosen = seeding.pixels(empty, stride, self.cap - len(self))
        if chosen is None:
            return 0
        v, u = chosen
        depth = np.asarray(1 / swept.sweep.inverse_depth[v, u], np.float32)
        colours = fill_mosaic(rate, self.channels)[v, u]
        self._add(chosen, depth, colours, stride, swept.rotation, swept.centre, swept.view.time)
        return len(u)

    def seed_view(self, view: View, rotation: Array, centre: Array, depth: Image) -> None:
        """Begin the map with one view at a depth for each pixel [H, W]."""
        rate, seeding = view.rate, self.options.seeding
        self._adapt_white(rate)
        stride = seeding.stride(rate.size, int(self.cap / self.extent), self.options.stride_px)
        chosen = seeding.pixels(np.ones(rate.shape, bool), stride, self.cap)
        if chosen is not None:
            colours = fill_mosaic(rate, self.channels)[chosen]
            self._add(chosen, depth[chosen], colours, stride, rotation, centre, view.time)

    def _adapt_white(self, rate: Image) -> None:
        """Before the splats of a seeded view with these rates are added, if there are any."""
        if len(self) == 0:
            self.white = self.shown_white = float(np.percentile(rate, WHITE_PERCENTILE))
        # Without the noise, of which the brightest of many views would have the most.
        sites = [rate] if self.channels is None else [rate[i::2, j::2] for i in (0, 1) for j in (0, 1)]
        smooth = np.concatenate([cv2.blur(site, NOISE_PX).ravel() for site in sites])
        bright = float(np.percentile(smooth, WHITE_PERCENTILE))
        if bright > BRIGHTER * self.shown_white:
            self.shown_white = bright

    def _add(
        self,
        pixels: tuple[NDArray[np.int64], NDArray[np.int64]],
        depth: Image,
        colours: Image,
        apart_px: float,
        rotation: Array,
        centre: Array,
        home: float | None,
    ) -> None:
        """Add round splats at rows and columns of an image that are `apart_px` apart, at the depths [N]; `home` is the
        time of its view."""
        v, u = pixels
        at, deviation_px = np.stack([u + 0.5, v + 0.5], 1), self.options.seeding.size * apart_px
        intrinsics = self.camera.intrinsics
        self.descent.join(isotropic_splats(intrinsics, at, depth, colours, deviation_px, rotation, centre))
        self.homes.add(len(u), home)

    def adopt(self, scene: Scene) -> None:
        """Go on with another scene."""
        self.descent.adopt(scene)
        self.homes = Homes(len(scene))

    def carry(self, chosen: NDArray[np.bool_], places: Places) -> None:
        """Move the splats of the `chosen` homes to where these are now, by the `places` of all of them."""
        self.descent.replace(self.homes.carry(self.scene, chosen, places))

    def leave(self, chosen: NDArray[np.bool_]) -> None:
        """Remove the splats of the `chosen` homes."""
        self._remove(self.homes.splats(chosen))

    def level(self, coarse: float) -> Level:
        """The pyramid level for a coarseness from 0 (full size) to 1 (smallest)."""
        return self.levels[int(np.ceil(coarse * (len(self.levels) - 1)))]

    def fit_motion(self, fast: bool) -> None:
        """Take the rates and densification of fast or of slow motion; moments, in their units, begin anew then."""
        if fast != self.fast:
            self.fast = fast
            self.descent.adopt(self.descent.scene)

    def step(self, key: int, view: View, request: RenderRequest, decay: float, level: Level) -> None:
        """One gradient step on the view of id `key`; `decay` scales all learning rates."""
        # A random background: otherwise dark surfaces become holes.
        background = float(self._rng.uniform(0, self.options.background)) * self.white
        if request.warp is None:
            self._fit_rates(key, view, request, background, decay, level)
        else:
            self._fit_charge(key, request, background, decay, level)

    def _fit_rates(
        self, key: int, view: View, request: RenderRequest, background: float, decay: float, level: Level
    ) -> None:
        """A step on a view's rates over its pixels' windows."""
        first = self.options.demosaic_first and level.mosaic is not None
        known = self.nuisances if level.factor == 1 and not first and self._knows_nuisances() else None
        gains = self.steps >= GAINS_FROM
        step = RateStep(key, view, request, level, self.view_loss, self.white, background, first, known, gains)
        stride = self._next_stride(decay, request.middle[1])
        self._losses[key] = self.map_steps.fit_rates(step, self.descent, stride)
        if known is not None and self.steps % NUISANCE_STEPS == 0:
            known.update()

    def replay(self, replay: Replay, decay: float) -> None:
        """One gradient step towards what another map shows."""
        background = float(self._rng.uniform(0, self.options.background)) * self.white
        image = replay.render(self.descent.model, background)
        shown = replay.comparable(image.values)
        slope = self.rate_loss(shown, replay.target(shown), self.white)[1]
        self._descend(replay.rasteriser, replay.slope(slope, image.values), decay, replay.centre)

    def _descend(self, rasteriser: AnyRasteriser, slope: Image, decay: float, centre: Array) -> None:
        """A step along the gradient of an image that was seen from `centre`."""
        self.descent.step(rasteriser, slope, *self._next_stride(decay, centre))

    def _next_stride(self, decay: float, centre: Array) -> Stride:
        """How far the next step goes, on an image that was seen from `centre`; counts it."""
        self.steps, rates = self.steps + 1, self.options.rates_of(self.fast)
        scaled = tuple(decay * rate for rate in rates.of_arrays(self.white))
        return Stride(scaled, self._limits(centre), rates.axes(self.depth, self.camera.intrinsics.fx))

    def _limits(self, centre: Array) -> SizeLimits:
        """How large splats may be after a step on an image that was seen from `centre`."""
        pruning = self.options.pruning
        if self.camera.intrinsics.distortion is None or self.steps % pruning.widths_every:
            return SizeLimits(self._most_log_scale)
        return SizeLimits(self._most_log_scale, pruning.widest, (centre[0], centre[1], centre[2]))

    def _fit_charge(self, key: int, request: RenderRequest, background: float, decay: float, level: Level) -> None:
        """A step on the charge between the spikes of all frames around a view."""
        phase, knows = int(self._rng.integers(level.factor)), self._knows_nuisances()
        loss, nuisances = self.charge_loss, self.nuisances
        step = ChargeStep(key, request, level, loss, self.white, background, phase, nuisances, knows)
        stride = self._next_stride(decay, request.middle[1])
        self._losses[key] = self.map_steps.fit_charge(step, self.descent, stride)

    def _knows_nuisances(self) -> bool:
        return self.options.nuisances and self.steps >= NUISANCES_FROM

    @property
    def loss(self) -> float | None:
        """Mean over the views of the last weighted squared error, in units of the shown white squared; None before any
        step."""
        if not self._losses:
            return None
        return float(np.mean(list(self._losses.values()))) * (self.white / self.shown_white) ** 2

    def forget_views(self) -> None:
        """Drop what is stored for each view, after some were dropped."""
        self._losses.clear()
        self.nuisances.forget_views()

    @property
    def alignment_level(self) -> Level:
        """The pyramid level of the alignment: large images and mosaics use larger pixels."""
        large = self.channels is not None or self.camera.width * self.camera.height > LARGE_PIXELS
        return self.levels[min(1, len(self.levels) - 1)] if large else self.levels[0]

    def densify(self, key: int, view: View, request: RenderRequest) -> None:
        """Add splats at the largest errors of a view, as `options.densification` says."""
        rotation, centre = request.middle
        if request.warp is None:
            level = self.levels[0]
            target = level.target(view, request)
            image = level.render(self.descent.model, request, target.windows)
            certainty = self.rate_loss.certainty(target.deviation, self.white)
            error = (view.rate - self.nuisances.factor(key) * image.values) * certainty
        else:
            size = (self.camera.width, self.camera.height)
            error = cv2.resize(self.map_steps.charge_error, size, interpolation=cv2.INTER_LINEAR)
            image = self.rasteriser.forward(self.descent.model, rotation[None], centre[None])
        seen = fill_mosaic(view.rate, self.channels) if request.warp is None else image.values
        self._replace(error, seen, image.depth, rotation, centre, view.time)

    def densify_replay(self, replay: Replay) -> None:
        """Add splats where the map differs most from what another map shows."""
        image = replay.render(self.scene).values
        shown = replay.comparable(image)
        error = replay.target(shown).values - shown
        # What a grey map lacks of the brightness is added to each colour.
        seen = replay.values if shown.ndim == image.ndim else np.maximum(image + error[..., None], 0)
        self._replace(error, seen, replay.depth, replay.rotation, replay.centre, None)

    def _replace(
        self, error: Image, seen: Image, depth: Image, rotation: Array, centre: Array, home: float | None
    ) -> None:
        """Remove dead splats and add others where `error` is large, of the colours and depths of images [H, W]."""
        strategy = self.options.densification
        dead = strategy.dead(self.descent.opacity_logits)
        self._remove(dead)
        chosen = strategy.choose(error, int(dead.sum()), self.cap, self.cap - len(self), self._rng, fast=self.fast)
        if chosen is None:
            return
        v, u = chosen
        colours = seen.reshape(*seen.shape[:2], -1)[v, u]
        self._add(chosen, np.where(depth > 0, depth, 1.0)[v, u], colours, 1.0, rotation, centre, home)

    def limit_sizes(self) -> None:
        """Let no splat grow beyond what `options.pruning` allows in a scene of the present size."""
        self._most_log_scale = float(np.log(self.options.pruning.largest(self.scene)))

    def prune(self, poses: Iterable[tuple[Array, Array, float]]) -> None:
        """Remove splats that no view needs: rotation, centre and depth of the nearest points of each."""
        level = self.alignment_level
        self._remove(self.options.pruning.needless(self.scene, level.rasteriser, poses, level.factor))

    def _remove(self, chosen: NDArray[np.bool_]) -> None:
        """Remove splats, [N]."""
        if chosen.any():
            self.descent.select(~chosen)
            self.homes.select(~chosen)

    def render(self, rotation: Array, centre: Array) -> Image:
        """Render the map from a pose: radiance [H, W, C]."""
        values = self.rasteriser.forward(self.scene, rotation[None], centre[None]).values
        return values[..., None] if values.ndim == 2 else values
