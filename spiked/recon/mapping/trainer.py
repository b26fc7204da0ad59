"""Training of the map: which view each step takes, how it is rendered, and which views are swept for depth."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from spiked.calibration import Calibration
from spiked.pose import Array
from spiked.recon.background import Background
from spiked.recon.frontend.windowing import View
from spiked.recon.mapping.carrying import Places
from spiked.recon.mapping.depth_sweeps import DepthSweeps, PosedViews
from spiked.recon.mapping.loss import Comparison, LossName
from spiked.recon.mapping.mapper import Mapper
from spiked.recon.mapping.options import MapOptions
from spiked.recon.mapping.pyramid import Level, Target
from spiked.recon.mapping.render_requests import RenderPlanner, RenderRequest
from spiked.recon.mapping.seeding import SweptView
from spiked.recon.view_store import ViewStore
from spiked.render import Camera
from spiked.render.splats import RenderedImage
from spiked.sensor import LEAST_DEPTH, Image, Intrinsics, Response, Sensor
from spiked.spline import Path, Waypoints

CARRIED_PX = 1.5
"""Motion of a view, in px, from which on its splats are carried: it takes 20 ms."""
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
        self._sweeps = DepthSweeps(self.camera, self.sensor.mosaic, self.views, self.options.seeding)
        self._sweeping: Background[SweptView] | None = None
        """The sweep that runs on another thread."""
        self._swept_px = -np.inf
        """Image motion of the path when that was begun."""
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

    def fast_share(self, ids: Sequence[int]) -> float:
        """The share of views that see fast motion; 0 of none."""
        return float(np.mean([self.views[i].frames.warped is not None for i in ids])) if ids else 0.0

    def mostly_fast(self, ids: Sequence[int]) -> bool:
        """Whether most of these views see fast motion."""
        return self.fast_share(ids) > 0.5

    def fit_motion(self, path: Path) -> None:
        """Let the map be fitted as suits most of the views on the path."""
        self.mapper.fit_motion(self.mostly_fast(self.views.mappable(path)))

    def reshuffle(self) -> None:
        """Draw a new random order of the views at the next step."""
        self._queue = []

    def forget_views(self) -> None:
        """Drop what is stored for each view, after some were dropped."""
        self.reshuffle()
        self.mapper.forget_views()

    def seed(self, path: Path, points: Array, ids: list[int]) -> None:
        """Sweep the depth of views and seed splats where the map is empty.

        points [N, 3] are landmarks, whose depths give the range of the sweep.
        """
        posed = self._posed(path)
        works = (self._sweeps.prepare(posed, posed.ids.index(one), points, threads=self.threads) for one in ids)
        self._plant(path, [work() for work in works if work is not None], (self.options.seeding.sure, 0.0))

    def _sweep_now(self, path: Path, points: Array) -> None:
        """As `sweep_behind`, on this thread."""
        self._swept_px = self.views.travelled_px
        work = self._prepare_quick(path, points, self.threads)
        self._plant(path, [] if work is None else [work()])

    def sweep_behind(self, path: Path, points: Array) -> None:
        """Seed the view that another thread has swept, and let it sweep a recent one if the camera has moved on.

        points [tracks, 3] are those of all tracks by id, NaN where unknown.
        """
        if self._sweeping is not None and self._sweeping.done:
            swept, self._sweeping = self._sweeping.result(), None
            (rotation,), (centre,) = path.poses([swept.view.time])
            self.carry(path)
            self._plant(path, [replace(swept, rotation=rotation, centre=centre)])
            self.carry(path)
        if self._sweeping is not None or not self.sweep_due:
            return
        self._swept_px = self.views.travelled_px
        if (work := self._prepare_quick(path, points, threads=1)) is not None:
            self._sweeping = Background(lambda stop: work(), behind=True)

    def _prepare_quick(self, path: Path, points: Array, threads: int | None) -> Callable[[], SweptView] | None:
        """A quick sweep of a recent view, with others on both sides of it."""
        posed = self._posed(path)
        row = len(posed.ids) - 3
        seen = points[self.views[posed.ids[row]].tracked.ids]
        return self._sweeps.prepare_quick(posed, row, seen[np.isfinite(seen[:, 0])], threads)

    def _posed(self, path: Path) -> PosedViews:
        ids = self.views.mappable(path)
        return PosedViews(ids, *path.poses([self.views[i].time for i in ids]))

    @property
    def sweep_due(self) -> bool:
        """Whether `sweep_behind` has something to do."""
        if self._sweeping is not None:
            return self._sweeping.done
        moved_px = self.views.travelled_px - self._swept_px
        return len(self.mapper) > 0 and moved_px > self.options.seeding.live_px

    def _plant(self, path: Path, swept: list[SweptView], surer: tuple[float, ...] = (0.0,)) -> None:
        """Seed splats from swept views where the map is empty, first where the depth is `surer`."""
        begins = len(self.mapper) == 0
        self.fit_motion(path)
        self.mapper.extent = self.extent
        for least in surer:
            for one in swept:
                self.mapper.seed(one, least)
        if swept:
            self.planner.depth, self._seeded_at = swept[-1].depth, swept[-1].view.time
        if swept and begins:
            self.mapper.depth = float(np.median([one.depth for one in swept]))
        self.version += 1

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
        target = level.target(view, request)
        image = level.render(self.mapper.descent.model, request, target.windows)
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

    def train_live(self, path: Path, points: Array, until: float, behind: bool) -> None:
        """Seed recent views if needed, then take steps until that time of `time.perf_counter`.

        points [tracks, 3] are those of all tracks by id, NaN where unknown; `behind`: another thread may sweep.
        """
        ids, quick = self.views.mappable(path), isinstance(path, Waypoints)
        if quick:
            self.carry(path)
        if quick and (len(self.mapper) == 0 or (self.sweep_due and not behind)):
            self._sweep_now(path, points)
        elif len(self.mapper) == 0:
            self.seed(path, points, [ids[len(ids) // 2]])
        elif quick:
            self.sweep_behind(path, points)
        elif self.options.seeding.due([self.views[i].time for i in ids], self._seeded_at):
            self.seed(path, points, [ids[-3]])
        while time.perf_counter() < until:
            self.step(path, 1.0, self.options.schedule.live_coarseness(self.mapper.steps), 0.0)
        if quick:
            self.carry(path)

    def carry(self, path: Path) -> None:
        """Move splats with the views they were seeded from, where the path has moved since: a closed loop does not tear
        the map. Those of views that have lost their pose are removed."""
        mapper, homes = self.mapper, self.mapper.homes
        views = [self.views.at(time).tracked for time in homes.times]
        places = Places(*path.poses(homes.times), np.array([view.scale for view in views]))
        homes.note(places)
        lost = np.array([view.rotation is None for view in views], bool)
        far = homes.places.moved_px(places, self.camera.intrinsics.fx, mapper.depth) > CARRIED_PX
        if lost.any():
            mapper.leave(lost)
        if (far := far & ~lost).any():
            mapper.carry(far, places)
            self.version += 1

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
