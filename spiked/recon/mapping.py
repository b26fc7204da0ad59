"""The map: Gaussians fitted to views by gradient descent, added where it is empty or wrong, moved where dead."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from spiked.calibration import Calibration
from spiked.pose import Array
from spiked.recon.depth import Sweep
from spiked.recon.levels import Level, Target, levels
from spiked.recon.nuisances import Nuisances
from spiked.recon.options import MapOptions
from spiked.recon.passage import Passage
from spiked.recon.views import Image, View, luminance
from spiked.render import Camera, Gradients
from spiked.render.charge import ChargeLoss
from spiked.render.loss import dssim
from spiked.render.optimiser import Adam
from spiked.render.splats import Image as Rendered
from spiked.scene import Scene
from spiked.sensor import Sensor

SSIM_SCALE = 0.01
"""Brings 1 - SSIM to the size of the mean squared error."""


LARGE_PIXELS = 130_000
"""Images of more pixels are aligned at half their size."""
SEED_SHARE = 0.3
"""Part of all splats that one view may begin with."""
DETAIL, DETAIL_PX = 3.0, 1.5
"""How much more is made of a slope's detail finer than so many (large) pixels, for fast motion."""
BETAS = 0.9, 0.99
"""Adam's memory, in steps that see a splat: many see few."""
NUISANCES_FROM = 50
"""Steps before they are estimated at all: first the map has to look like something."""
GAINS_FROM = 800
"""Steps before the gains of pixels are: they would take on what the geometry has yet to explain."""
NUISANCE_STEPS = 200
"""Steps between estimates of the pixels' gains."""


@dataclass(frozen=True)
class Sight:
    """From where a view was seen: poses, camera-to-world, and when each pixel looked."""

    rotations: Array
    """[S, 3, 3]"""
    centres: Array
    """[S, 3]"""
    windows: Image | None = None
    """[2, H, W] for a camera that moves from pose to pose (`Rasteriser.forward_moving`); None: it stands still."""
    seen: NDArray[np.bool_] | None = None
    """[H, W], which pixels looked in these windows; None: all."""
    passage: Passage | None = None
    """Fast motion: the frames around the one pose that is given, compared with what was seen from there."""


class Mapper:
    """Holds the scene and improves it, a view at a time."""

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
        self.scene = Scene.empty(self.colours)
        self.white = 1.0
        self.depth = 1.0
        """Typical depth of the scene, which the rate of the means is in units of."""
        self.rasteriser = self.levels[0].rasteriser
        self.adam = Adam(self.scene.arrays(), *BETAS, threads=threads)
        self.nuisances = Nuisances(sensor.height, sensor.width)
        self.steps = 0
        self._calibration = calibration
        self._charge = ChargeLoss(sensor, threads)
        self._wrong: Image = np.zeros((1, 1), np.float32)
        self._rng = np.random.default_rng(seed)
        self._residuals: dict[int, float] = {}

    @property
    def cap(self) -> int:
        """Most splats that the map may hold."""
        share = self.options.splats_a_pixel * self.camera.width * self.camera.height
        return min(int(share), self.options.most_splats)

    def seed_from(self, view: View, rotation: Array, centre: Array, swept: Sweep, surer: float = 0.0) -> int:
        """Splats from the pixels of a swept view that the map does not cover yet and whose depth has at least so much
        confidence; returns how many."""
        height, width = view.rate.shape
        if len(self.scene):
            empty = self.rasteriser.forward(self.scene, rotation[None], centre[None]).alpha < 0.5
        else:
            self.white = float(np.percentile(view.rate, 99.5))
            empty = np.ones((height, width), bool)
        empty &= swept.confidence >= surer
        # The first view leaves room for what others see; all of it gets splats, however few there may be.
        step = max(self.options.stride_px, float(np.sqrt(height * width / (SEED_SHARE * self.cap))))
        v, u = (
            g.ravel().astype(int)
            for g in np.meshgrid(np.arange(step / 2, height, step), np.arange(step / 2, width, step), indexing="ij")
        )
        keep = empty[v, u]
        u, v = u[keep][: self.cap - len(self.scene)], v[keep][: self.cap - len(self.scene)]
        if len(u) < 20:
            return 0
        smooth = fill_mosaic(view.rate, self.channels)
        self._append(u + 0.5, v + 0.5, 1 / swept.inverse_depth[v, u], smooth[v, u], step, rotation, centre)
        return len(u)

    def _append(
        self, u: Array, v: Array, depth: Image, colour: Image, size_px: float, rotation: Array, centre: Array
    ) -> None:
        """Round splats of `size_px` pixels spacing at pixels (u, v) of a camera."""
        k = self.camera.intrinsics
        rays = np.stack([(u - k.cx) / k.fx, (v - k.cy) / k.fy, np.ones_like(u)], 1)
        n = len(u)
        log_scale = np.log(0.6 * size_px * depth / k.fx)
        quats = np.zeros((n, 4), np.float32)
        quats[:, 0] = 1
        fresh = Scene(
            np.ascontiguousarray((rays * depth[:, None]) @ rotation.T + centre, np.float32),
            quats,
            np.repeat(log_scale[:, None], 3, 1).astype(np.float32),
            np.full(n, 0.5, np.float32),
            np.ascontiguousarray(colour, np.float32),
        )
        self.scene = self.scene.join(fresh)
        self.adam.grow(n)

    def level(self, coarse: float) -> Level:
        """The size at which views are looked at: 0 is the full one, 1 the smallest."""
        return self.levels[int(np.ceil(coarse * (len(self.levels) - 1)))]

    def step(self, key: int, view: View, sight: Sight, decay: float, level: Level) -> Gradients:
        """One gradient step on a view; `decay` scales all rates. Returns the gradients (for the poses)."""
        # A background of any brightness: dark things have to be there, not to be holes.
        background = float(self._rng.uniform(0, self.options.background)) * self.white
        if sight.passage is None:
            slope = self._by_window(key, view, sight, level, background)
        else:
            slope = self._by_charge(key, sight, sight.passage, level, background)
        gradients = level.rasteriser.backward(slope)
        self.steps += 1
        o = self.options
        others = (o.rate_quats, o.rate_scales, o.rate_opacities, o.rate_colours * self.white)
        rates = tuple(decay * rate for rate in (o.rate_means * self.depth, *others))
        slopes = (gradients.means, gradients.quats, gradients.log_scales, gradients.opacity_logits, gradients.colours)
        self.adam.step(self.scene.arrays(), slopes, rates, gradients.radius_px > 0)
        # Light taken away would fit as well, but viewers of the scene know none: they show such splats as black.
        np.maximum(self.scene.colours, 0, out=self.scene.colours)
        return gradients

    def _by_window(self, key: int, view: View, sight: Sight, level: Level, background: float) -> Image:
        """The derivative of the loss by the image, of a view's rates over its pixels' windows."""
        target = level.target(view, sight.windows, sight.seen)
        image = _look(level, self.scene, replace(sight, windows=target.windows), background)
        expected = image.values
        factor: Image | None = None
        if level.factor == 1 and self._knows_nuisances():
            factor = self.nuisances.factor(key)
            self.nuisances.observe(key, image.values, view.rate, target.deviation, self.steps >= GAINS_FROM)
            expected = expected * factor
            if self.steps % NUISANCE_STEPS == NUISANCE_STEPS - 1:
                self.nuisances.update()
        slope, self._residuals[key] = self._slope(expected, target, level)
        if factor is not None:
            slope *= factor
        return slope

    def _by_charge(self, key: int, sight: Sight, passage: Passage, level: Level, background: float) -> Image:
        """As `_by_window`, of the charge between the spikes of all frames around a view."""
        rotation, centre = sight.rotations[0], sight.centres[0]
        image = level.rasteriser.forward(self.scene, sight.rotations, sight.centres, background=background)
        moved = passage.displacements(self.camera, rotation, centre, image.depth)
        calibration, dark = self._calibration, None
        gain = self.nuisances.factor(key)
        if calibration is not None:
            gain, dark = np.where(calibration.dead, 0, gain * calibration.gain), calibration.dark
        floor = self.options.floor * self.white
        # An image of large pixels has enough of a part of the sensor's rows.
        every, phase = level.factor, int(self._rng.integers(level.factor))
        charge = self._charge(
            image.values, passage.frames, moved, gain, dark, pixel=level.factor, every=every, phase=phase, floor=floor
        )
        if self._knows_nuisances():
            self.nuisances.note(key, self.nuisances.level(key) * charge.brightness)
        self._residuals[key] = charge.loss / self.white**2
        self._wrong = charge.slope if every == 1 else cv2.blur(charge.slope, (1, every))
        slope = charge.slope if level.factor > 1 else _finer(charge.slope)
        return slope / np.float32(self.white**2)

    def _knows_nuisances(self) -> bool:
        return self.options.nuisances and self.steps >= NUISANCES_FROM

    def _slope(self, expected: Image, target: Target, level: Level) -> tuple[Image, float]:
        """The derivative of the loss by what is expected, and the weighted mean squared error in units of white."""
        error = expected - target.values
        weight = self._certainty(target.deviation)
        scale = np.float32(1 / (self.white**2 * error.size))
        slope = 2 * scale * weight * error
        if self.options.ssim > 0:
            share, structural = self.options.ssim, self._structural(expected, target, level)
            slope = (1 - share) * slope + share * SSIM_SCALE * structural
        return slope, float(np.mean(weight * error * error)) / self.white**2

    def _certainty(self, deviation: Image) -> Image:
        """Weight of a squared error, 1 for a noiseless pixel."""
        floor = np.float32((self.options.floor * self.white) ** 2)
        return np.asarray(floor / (deviation**2 + floor), np.float32)

    def _structural(self, expected: Image, target: Target, level: Level) -> Image:
        """The slope of 1 - SSIM; a mosaic is compared in grey, where every colour has the same share everywhere."""
        if level.channels is None:
            return dssim(expected, target.values, self.white)[1]
        grey = luminance(expected, self.sensor.mosaic), luminance(target.values, self.sensor.mosaic)
        # The mean over sites is symmetric, so that its transpose is itself.
        return luminance(dssim(*grey, self.white)[1], self.sensor.mosaic)

    @property
    def loss(self) -> float | None:
        """Mean over the views of the last weighted squared error, in units of white squared; None before any step."""
        return float(np.mean(list(self._residuals.values()))) if self._residuals else None

    def forget_residuals(self) -> None:
        """Views are numbered anew."""
        self._residuals.clear()
        self.nuisances.forget_views()

    @property
    def alignment_level(self) -> Level:
        """The size at which the path is aligned: large images and mosaics are looked at with larger pixels."""
        large = self.channels is not None or self.camera.width * self.camera.height > LARGE_PIXELS
        return self.levels[min(1, len(self.levels) - 1)] if large else self.levels[0]

    def look(self, sight: Sight, level: Level | None = None) -> Rendered:
        """The map as a view saw it, at full size or at that of a level (which the sight's windows must have)."""
        return _look(level or self.levels[0], self.scene, sight, 0.0)

    def densify(self, key: int, view: View, sight: Sight, share: float = 0.02) -> None:
        """Give splats to what is rendered worst: in place of dead ones first, then new ones up to the cap."""
        middle = len(sight.centres) // 2
        rotation, centre = sight.rotations[middle], sight.centres[middle]
        if sight.passage is None:
            image = self.look(sight)
            certainty = self._certainty(self.levels[0].target(view, sight.windows, sight.seen).deviation)
            error = (view.rate - self.nuisances.factor(key) * image.values) * certainty
        else:
            image = self.rasteriser.forward(self.scene, rotation[None], centre[None])
            error = cv2.resize(self._wrong, (self.camera.width, self.camera.height), interpolation=cv2.INTER_LINEAR)
        badness = cv2.GaussianBlur(np.abs(cv2.GaussianBlur(error, (0, 0), 0.7)), (0, 0), 1.0)
        badness = badness.sum(-1) if badness.ndim == 3 else badness
        badness = np.maximum(badness - np.median(badness), 0)
        dead = np.flatnonzero(self.scene.opacity_logits < -4.0)
        if len(dead):
            alive = np.ones(len(self.scene), bool)
            alive[dead] = False
            self.scene = self.scene.select(alive)
            self.adam.keep(alive)
        wanted = min(int(share * self.cap) + len(dead), self.cap - len(self.scene))
        total = float(badness.sum())
        if wanted < 1 or total <= 0:
            return
        place = self._rng.choice(
            badness.size, min(wanted, badness.size // 4), replace=False, p=(badness / total).ravel()
        )
        v, u = np.divmod(place, self.camera.width)
        depth = np.where(image.depth > 0, image.depth, 1.0)[v, u]
        seen = fill_mosaic(view.rate, self.channels) if sight.passage is None else image.values
        colour = seen.reshape(*seen.shape[:2], self.colours)[v, u]
        self._append(u + 0.5, v + 0.5, depth, colour, 1.0, rotation, centre)

    def render(self, rotation: Array, centre: Array) -> Image:
        """What the map looks like from a pose, radiance [H, W] or [H, W, 3]."""
        return self.rasteriser.forward(self.scene, rotation[None], centre[None]).values


def _finer(slope: Image) -> Image:
    """A slope [h, w] or [h, w, C] with fine detail raised: intervals are sums along the motion, and say it weakly."""
    blurred = cv2.GaussianBlur(slope, (0, 0), DETAIL_PX).reshape(slope.shape)
    return np.asarray(slope + np.float32(DETAIL) * (slope - blurred), np.float32)


def _look(level: Level, scene: Scene, sight: Sight, background: float) -> Rendered:
    r, c = sight.rotations, sight.centres
    render = level.rasteriser
    if sight.windows is None:
        return render.forward(scene, r, c, channels=level.channels, background=background)
    return render.forward_moving(scene, r, c, sight.windows, channels=level.channels, background=background)


def fill_mosaic(rate: Image, channels: NDArray[np.uint8] | None) -> Image:
    """Colours [H, W, C] of an observed image, for display and first guesses.

    Each colour is the normalised average of its own sites nearby; grey passes through.
    """
    if channels is None:
        return rate[..., None]
    planes = []
    for c in range(3):
        here = (channels == c).astype(np.float32)
        planes.append(cv2.GaussianBlur(rate * here, (5, 5), 0) / np.maximum(cv2.GaussianBlur(here, (5, 5), 0), 1e-6))
    return np.stack(planes, -1)
