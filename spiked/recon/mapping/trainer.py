"""Training of the map: which view each step takes, how it is rendered, and which views are swept for depth."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from spiked.calibration import Calibration
from spiked.pose import Array
from spiked.recon.frontend.windowing import View, luminance
from spiked.recon.mapping.loss import Comparison, LossName
from spiked.recon.mapping.mapper import Mapper
from spiked.recon.mapping.options import MapOptions
from spiked.recon.mapping.plane_sweep import SWEPT_PIXELS, PosedImage, Sweep, neighbours, sweep
from spiked.recon.mapping.pyramid import Level, Target
from spiked.recon.mapping.render_requests import RenderPlanner, RenderRequest
from spiked.recon.mapping.seeding import SweptView
from spiked.recon.view_store import ViewStore
from spiked.render import Camera
from spiked.render.splats import RenderedImage
from spiked.sensor import LEAST_DEPTH, Image, Intrinsics, Response, Sensor
from spiked.spline import Path, Waypoints
from spiked.undistortion import Undistortion, widest_undistortion

QUICK_SWEEP = 4
"""Divisor of the swept pixels where views are far apart: 0.1 s, short enough not to lose a fast camera."""
SWEPT_SIDES = 2.5
"""Longest side of undistorted images that are swept, in widths of the sensor."""
UNKNOWN_NOISE = 1e6
"""Deviation of pixels outside of the image, in spikes a frame: they weigh nothing."""
VERSION_STEPS = 20
"""Steps from one version of the map to the next."""


@dataclass(frozen=True)
class ViewRender:
    """A rendered view; the rasteriser of its level can go backward until it renders again."""

    level: Level
    request: RenderRequest
    """With the times of its sub-frames."""
    target: Target
    image: RenderedImage
    expected: Image
    """Rates of the size of the level, with the gains of the pixels."""
    factor: Image | None
    """These gains, if they are known."""


class MapTrainer:
    """Fits a map to the views of a path, in steps, live and in the refinement."""

    def __init__(
        self,
        sensor: Sensor,
        views: ViewStore,
        options: MapOptions,
        seed: int,
        threads: int | None = None,
        calibration: Calibration | None = None,
    ) -> None:
        """The sensor has intrinsics."""
        assert sensor.intrinsics is not None
        self.sensor = sensor
        self.views = views
        self.options = options.for_photons() if sensor.response is Response.BERNOULLI else options
        self.version = 0
        """Increases when the map changes."""
        self.threads = threads
        self._seed, self._calibration = seed, calibration
        self._rng = np.random.default_rng(seed)
        self.loss = options.loss
        """What the map is fitted to."""
        self._only: frozenset[int] | None = None
        camera = Camera(sensor.intrinsics, sensor.width, sensor.height)
        self.planner = RenderPlanner(camera, options.sub_frames, blur_matched=options.blur_matched)
        self.restart()

    @property
    def camera(self) -> Camera:
        """The camera of the map."""
        return self.planner.camera

    def restart(self, intrinsics: Intrinsics | None = None) -> None:
        """Start an empty map, with other intrinsics if given."""
        if intrinsics is not None:
            self.sensor = replace(self.sensor, intrinsics=intrinsics)
            self.planner.camera = replace(self.camera, intrinsics=intrinsics)
        self.mapper = Mapper(self.sensor, self.camera, self.options, self._seed, self.threads, self._calibration)
        self._queue: list[int] = []
        self._seeded_at = -np.inf
        """Time in frames of the view that was seeded last."""
        self._fitted_path: Path | None = None
        """The path of the last step."""

    @property
    def extent(self) -> float:
        """Size of the map by the path so far, see `extent_of`."""
        return self.extent_of(self.views.travelled_px)

    def extent_of(self, travelled_px: float) -> float:
        """Size of the map of a path, see `MapOptions.extent_px`; limited by the number of splats."""
        pixels, options = self.camera.width * self.camera.height, self.options
        most = max(1.0, options.most_splats / (options.splats_a_pixel * pixels))
        return float(np.clip(travelled_px / options.extent_px, 1.0, most))

    def reshuffle(self) -> None:
        """Draw a new random order of the views at the next step."""
        self._queue = []

    def forget_views(self) -> None:
        """Drop what is stored for each view, after some were dropped."""
        self.reshuffle()
        self.mapper.forget_views()

    def seed(self, path: Path, points: Array, ids: list[int], quick: bool = False) -> None:
        """Sweep the depth of views and seed splats where the map is empty.

        points [N, 3] are landmarks, whose depths give the range of the sweep; quick: sweep small images.
        """
        self.mapper.extent = self.extent
        begins, mappable = len(self.mapper) == 0, self.views.mappable(path)
        poses = path.poses([self.views[i].time for i in mappable])
        found = [self._sweep(mappable, *poses, mappable.index(view_id), points, quick) for view_id in ids]
        swept = [one for one in found if one is not None]
        for one in swept:
            self.mapper.seed(one, self.options.seeding.sure)
        for one in swept:
            self.mapper.seed(one)
        if swept:
            self.planner.depth, self._seeded_at = swept[-1].depth, swept[-1].view.time
        if swept and begins:
            self.mapper.depth = float(np.median([one.depth for one in swept]))
        self.version += 1

    def _sweep(
        self, ids: list[int], rotations: Array, centres: Array, row: int, points: Array, quick: bool
    ) -> SweptView | None:
        """The depth of view `ids[row]`, compared with others of `ids`; None if too few points are in front of it.

        rotations [V, 3, 3] and centres [V, 3] are the poses of `ids`, camera to world.
        """
        seeding, view = self.options.seeding, self.views.image(ids[row])
        depths = (points - centres[row]) @ rotations[row][:, 2]
        planes = seeding.planes(depths)
        if planes is None:
            return None

        lens = None
        if self.camera.intrinsics.distortion is not None:  # the sweep's warps are homographies
            lens = widest_undistortion(self.camera.intrinsics, self.camera.width, self.camera.height, SWEPT_SIDES)

        def posed(at: int) -> PosedImage:
            image = luminance(self.views.image(ids[at]).rate, self.sensor.mosaic)
            image = image if lens is None else lens.straighten(image, np.nan)
            return PosedImage(image, rotations[at], centres[at])

        others = [posed(at) for at in neighbours(centres, rotations[:, :, 2], row, seeding.neighbours)]
        pixels = SWEPT_PIXELS // QUICK_SWEEP if quick else SWEPT_PIXELS
        noise = seeding.noise * view.deviation
        if lens is None:
            swept = sweep(posed(row), others, self.camera.intrinsics, planes, noise, pixels, self.threads)
        else:
            swept = self._sweep_straight(lens, posed(row), others, planes, noise, pixels)
        return SweptView(view, rotations[row], centres[row], float(np.median(depths[depths > 0])), swept)

    def _sweep_straight(
        self,
        lens: Undistortion,
        reference: PosedImage,
        others: list[PosedImage],
        planes: tuple[float, float],
        noise: Image,
        pixels: int,
    ) -> Sweep:
        """A sweep of undistorted images, bent again. Pixels outside of the reference say nothing."""
        known = np.isfinite(reference.image)
        filled = replace(reference, image=np.where(known, reference.image, np.float32(0)))
        straight = np.where(known, lens.straighten(noise), np.float32(UNKNOWN_NOISE))
        pixels = round(pixels * known.size / noise.size)
        swept = sweep(filled, others, lens.straight, planes, straight, pixels, self.threads)
        return Sweep(lens.bend(swept.inverse_depth), lens.bend(np.where(known, swept.confidence, np.float32(0))))

    def shown(self, view_id: int) -> View:
        """The image of a view as the map is fitted to it."""
        return self.views.image(view_id).showing(self.loss.target)

    def fit_with(self, loss: LossName) -> None:
        """Fit the map with another loss from now on; the views have recorded what it needs."""
        self.loss = loss
        self.mapper.view_loss = replace(self.options, loss=loss).view_loss(self.threads)

    def use_only(self, ids: Sequence[int] | None) -> None:
        """Take steps on these views only; None: on all."""
        self._only = None if ids is None else frozenset(ids)
        self.reshuffle()

    def usable(self, path: Path) -> list[int]:
        """Ids of the views that steps are taken on."""
        ids = self.views.mappable(path)
        return ids if self._only is None else [i for i in ids if i in self._only]

    def step(self, path: Path, decay: float, coarse: float, share: float) -> None:
        """One gradient step on the next view of a random order.

        `decay` scales the learning rates; `coarse` is the pyramid level, 0 to 1; `share` of the refinement is done.
        """
        if not self._queue:
            self._queue = [int(i) for i in self._rng.permutation(self.usable(path))]
        view_id = self._queue.pop()
        view, level = self.shown(view_id), self.mapper.level(coarse)
        request = self.planner.request(view, path, level.factor)
        self.mapper.step(view_id, view, request, decay, level)
        if self.options.densification.due(self.mapper.steps, share):
            self.mapper.densify(view_id, view, request)
        self._fitted_path = path
        self.version += self.mapper.steps % VERSION_STEPS == 0

    def render(self, path: Path, view_id: int, level: Level) -> ViewRender:
        """A view rendered over its exposure at the size of a level, with its target, by the sub-frames of its path."""
        view = self.shown(view_id)
        request = self.planner.exposed(view, path, level.factor)
        target = level.target(view, request.windows, request.seen)
        request = replace(request, windows=target.windows)
        image = level.render(self.mapper.descent.model, request)
        factor = None
        if level.factor == 1 and self.options.nuisances:
            factor = self.mapper.nuisances.factor(view_id)
            image = replace(image, values=image.values * factor)
        return ViewRender(level, request, target, image, image.values, factor)

    def compare(self, path: Path, view_id: int) -> Comparison:
        """A view compared with its render, by the loss of the map."""
        made = self.render(path, view_id, self.mapper.alignment_level)
        return self.mapper.view_loss.compare(made.expected, made.target, self.mapper.white, made.level.mosaic)

    def prune(self, path: Path, points: Array) -> None:
        """Remove splats that no view of the path needs; points [N, 3] are landmarks."""
        pruning = self.options.pruning
        ids = self.views.spread(self.views.mappable(path), pruning.views)
        rotations, centres = path.poses([self.views[i].time for i in ids])
        self.mapper.prune(
            (rotation, centre, self._nearest(points, rotation, centre))
            for rotation, centre in zip(rotations, centres, strict=True)
        )
        self.version += 1

    def _nearest(self, points: Array, rotation: Array, centre: Array) -> float:
        """Depth of the nearest landmarks in an image; 0 without any."""
        local = (points - centre) @ rotation
        at = self.camera.intrinsics.project(local)
        inside = (local[:, 2] > LEAST_DEPTH) & (at > 0).all(1) & (at < [self.camera.width, self.camera.height]).all(1)
        depths = local[inside, 2]
        return float(np.percentile(depths, self.options.pruning.near_percentile)) if len(depths) else 0.0

    def train_live(self, path: Path, points: Array, until: float) -> None:
        """Seed recent views if needed, then take steps until that time of `time.perf_counter`."""
        ids, quick = self.views.mappable(path), isinstance(path, Waypoints)
        if len(self.mapper) == 0:
            self.seed(path, points, [ids[len(ids) // 2]], quick)
        elif self.options.seeding.due([self.views[i].time for i in ids], self._seeded_at):
            self.seed(path, points, [ids[-3]], quick)
        while time.perf_counter() < until:
            self.step(path, 1.0, self.options.schedule.live_coarseness(self.mapper.steps), 0.0)

    def stale(self, path: Path) -> bool:
        """Whether the path moved since the map was fitted to it, see `Schedule.stale_px`: such a map would bias the
        alignment."""
        old = self._fitted_path
        if old is None:
            return False
        times = [self.views[i].time for i in self.views.mappable(path)]
        times = [t for t in times if old.begin <= t <= old.end]
        if not times:
            return True
        poses = zip(*old.poses(times), *path.poses(times), strict=True)
        moved_px = [self.planner.motion_px(*both) for both in poses]
        return float(np.percentile(moved_px, 90)) > self.options.schedule.stale_px
