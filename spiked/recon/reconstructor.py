"""Frames in, trajectory and scene out, at any time: the one object that the command line and the daemon hold."""

import platform
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from typing import cast

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import ThreadpoolController

from spiked.errors import ConfigurationError
from spiked.pose import Array, log_so3
from spiked.recon.colour import contradicts
from spiked.recon.depth import SWEPT_PIXELS, Shot, neighbours, sweep
from spiked.recon.focal import FIRST_DEG, Focal
from spiked.recon.mapping import Mapper, Sight, fill_mosaic
from spiked.recon.odometry import SAME_FOCAL, WORST_PATH_ERROR, Odometry, State
from spiked.recon.options import Options
from spiked.recon.passage import Passage
from spiked.recon.refine import Known, align_spline
from spiked.recon.tracks import picture, white_of
from spiked.recon.views import Image, View, Windows, luminance
from spiked.render import Camera
from spiked.scene import Scene
from spiked.sensor import Intrinsics, Sensor
from spiked.spline import Path, Spline
from spiked.trajectory import Trajectory

SUB_FRAME_PX = 3.0
"""Image motion that one sub-frame of straight, blurred motion renders well."""
MAX_SUB_FRAMES = 6
COARSE_SHARE = 0.6
"""Part of the refinement in which large images are looked at with fewer, larger pixels: a quarter of the work each."""
SMALL_PIXELS = 130_000
"""Images up to here get all the steps that the options say."""
LARGE_POWER = 0.4
"""The steps of larger ones fall with this power of their pixels: each costs more, and they have more to settle."""
FAST_STEPS = 2.5
"""Times as many steps for views of fast motion, which cost less each and say less of what is fine."""
DENSIFY_EVERY = 20
"""Steps after which the view just seen gets splats where it is rendered worst: each part of the path has its turn."""
SETTLING_SHARE = 0.15
"""Last part of the refinement, in which the rates fall to nothing: each view pulls by its own noise, and the map would
end where the last ones did."""
YOUNG_STEPS = 800
"""Steps that a map which grows with the frames is looked at coarsely."""
SEED_VIEWS = 11
"""Views swept for depth when the map begins."""
SWEEP_NEIGHBOURS = 5
SURE_DEPTH = 0.6
"""Pixels of less confidence wait for a view that sees their place better: at the edges few others look there."""
ALIGNMENTS = 5
"""Times that the whole path is aligned with the map in a refinement."""
ALIGNED_SHARE = 0.7
"""Part of the refinement in which that happens; then the map settles on the path that was found."""
STALE_PX = 0.05
"""A map that was drawn along a path which then moved farther than this in the image, in a tenth of the views, is drawn
anew: otherwise the aligned path gives way to it (with 0.3: 0.08 % of error instead of 0.05 % on a living room followed
live, 6.5 % instead of 3.9 % where the camera moves by a hundredth of the scene's depth)."""
BRIDGED_S = 0.03
"""The path between two views is taken to be smooth over so much time: a hand trembles ten times a second."""
ALIGNED_VIEWS = 160
"""Views looked at for it, at most."""


@dataclass(frozen=True)
class Status:
    """Where a reconstruction stands."""

    state: State
    reason: str
    stage: str
    """waiting, tracking, mapping, refining or done."""
    frames: int
    splats: int
    loss: float | None
    """Mean squared error of the views in units of white squared, weighted by the noise."""
    version: int
    """Grows whenever the scene or the trajectory changed."""
    progress: float
    """Share of the final refinement done, 0 to 1."""
    inliers: float | None = None
    """Of the newest pose, as are the next two: the share of known points that agree with it."""
    chi2: float | None = None
    """Squared residual of a typical point over what noise explains; 1 is as it should be."""
    sigma_px: float | None = None
    """Predicted error, as a displacement of the image at the median depth."""


@dataclass(frozen=True)
class Tracked:
    """One view as it was tracked."""

    time: float
    """Middle of the view in frames."""
    time_s: float
    state: State
    rotation: Array | None
    """Camera to world, [3, 3]; None before the bootstrap and while lost."""
    centre: Array | None
    """[3], in the trajectory's unit."""
    rate: float
    """Mean spikes a pixel and frame."""
    sigma_px: float | None = None
    """Standard deviation of the pose in the image, where it is known."""
    chi2: float | None = None
    """Squared residual in units of its variance, where it is known."""


@dataclass(frozen=True)
class Sample:
    """One view's observed and rendered image [H, W, C], radiance, for people to compare."""

    time_s: float
    observed: Image
    rendered: Image


class Reconstructor:
    """Feed frames as they come (`feed`, `gap`), let it map in spare time (`improve`), end with `finish`.

    Poses are camera-to-world; the length unit is the median depth of the first views, or the unit of given poses.
    """

    def __init__(self, sensor: Sensor, options: Options | None = None) -> None:
        """A sensor without intrinsics has its focal length estimated; `sensor` and `camera` follow it.

        Raises ConfigurationError when poses are given without intrinsics.
        """
        self.options = options or Options()
        intrinsics = sensor.intrinsics
        if intrinsics is None:
            if self.options.poses is not None:
                raise ConfigurationError(
                    "the focal length is not known, and poses are given: give --fov DEGREES or --intrinsics fx,fy,cx,cy"
                )
            intrinsics = Intrinsics.from_fov(sensor.width, sensor.height, FIRST_DEG)
        self.sensor = replace(sensor, intrinsics=intrinsics)
        self.camera = Camera(intrinsics, sensor.width, sensor.height)
        self._windows = Windows(sensor, self.options.window_frames, self.options.calibration)
        focal = Focal(intrinsics, np.inf) if sensor.intrinsics is None else None
        self._odometry = Odometry(intrinsics, self.options.seed, focal)
        self._mapper = self._new_mapper()
        self._rng = np.random.default_rng(self.options.seed)
        self._views: list[View] = []
        self._room = np.empty((sensor.height, sensor.width), np.float32)
        self._queue: list[int] = []
        self._seeded: list[float] = []
        self._gaps: list[tuple[int, int]] = []
        self._bridged: set[int] = set()  # views between which and the one before frames were only passed over
        self._broken = True
        self._frames = 0
        self._version = 0
        self._stage = "waiting"
        self._progress = 0.0
        self._refined: Spline | None = None
        self._mapped: Path | None = None
        self._waypoints: Path | None = None
        self._strung = -1
        self._unit = 1.0
        self._depth = 1.0
        self._spent = {"tracking": 0.0, "mapping": 0.0, "refining": 0.0}
        self.warnings: list[str] = []
        """What a user should know about the recording, one sentence each."""
        self._curve: list[tuple[float, float]] = []
        # The matrices are small: on busy cores several BLAS threads made tracking three times slower than one.
        self._blas = ThreadpoolController()

    def _new_mapper(self) -> Mapper:
        options = self.options
        return Mapper(self.sensor, self.camera, options.mapping, options.seed, options.threads, options.calibration)

    @property
    def focal(self) -> Focal | None:
        """What is known of a focal length that nobody gave; None where it was given."""
        return self._odometry.focal

    def _follow_focal(self) -> None:
        """A map that was drawn with another focal length is drawn anew."""
        found = self._odometry.intrinsics
        if found == self.camera.intrinsics:
            return
        changed = abs(np.log(found.fx / self.camera.intrinsics.fx)) > SAME_FOCAL
        if self._stage != "refining" and not changed:
            return
        self.sensor = replace(self.sensor, intrinsics=found)
        self.camera = Camera(found, self.sensor.width, self.sensor.height)
        self._mapper, self._mapped = self._new_mapper(), None
        self._seeded, self._queue = [], []

    def feed(self, first_frame: int, frames: NDArray[np.uint8]) -> None:
        """Take stored frames uint8 [n, frame_bytes] that begin at absolute index `first_frame`."""
        begin = time.perf_counter()
        with self._one_blas_thread():
            for view in self._windows.feed(first_frame, frames):
                self._add(view)
        self._frames = first_frame + len(frames)
        self._spent["tracking"] += time.perf_counter() - begin

    def _one_blas_thread(self) -> AbstractContextManager[object]:
        return cast(AbstractContextManager[object], self._blas.limit(limits=1, user_api="blas"))

    @property
    def glance_frames(self) -> int:
        """Frames that `glance` makes its next view of."""
        return self._windows.glance_frames

    @property
    def speed_px(self) -> float | None:
        """Image motion a frame between the two newest views; None where nothing could be followed."""
        views = self._odometry.views
        if len(views) < 2 or not views[-1].motion_px:
            return None
        return views[-1].motion_px / (views[-1].time - views[-2].time)

    def glance(self, first_frame: int, frames: NDArray[np.uint8]) -> None:
        """Take one view from the middle of stored frames, and nothing of what came between it and the view before: for
        a camera that is faster than the tracker. The path is smooth in between, and has poses there."""
        begin = time.perf_counter()
        with self._one_blas_thread():
            broken = self._broken
            self._odometry.pass_over()
            self._add(self._windows.glance(first_frame, frames))
            if (
                not broken
                and self._odometry.views[-1].time - self._odometry.views[-2].time
                < BRIDGED_S * self.sensor.frame_rate_hz
            ):
                self._bridged.add(len(self._odometry.views) - 1)
        self._frames = first_frame + len(frames)
        self._spent["tracking"] += time.perf_counter() - begin

    def gap(self, first_frame: int, count: int) -> None:
        """Frames [first_frame, first_frame + count) were lost."""
        self._gaps.append((first_frame, count))
        self._broken = True

    def _add(self, view: View) -> None:
        sharp = view.sharp
        grey = luminance(view.glimpse(self._room), self.sensor.mosaic) if sharp is None else sharp
        image, edges = picture(grey, white_of(grey)), view.edges if sharp is None else None
        known = self._given(view)
        posed = self._odometry.add(view.time, view.end - view.begin, image, known, edges, view.after_gap)
        self._views.append(view)
        self._broken = False
        if len(self._views) == 1:
            self._check_colour(view)
        if self._stage == "waiting":
            self._stage = "tracking"
        if posed.rotation is not None:
            self._version += 1
        if len(self._views) > 1:
            self._windows.follow(posed.motion_px, view.time - self._views[-2].time)
        if len(self._views) > self.options.max_views:
            self._thin()

    def _check_colour(self, view: View) -> None:
        """Say it when the mosaic cannot be what the sensor says."""
        said = self.sensor.mosaic
        likelier = None if said is None else contradicts(said, view.rate)
        if likelier is not None:
            self.warnings.append(
                f"the colour mosaic is said to be {said}, but by the pixels green is where {likelier} has it: "
                "colours and fine detail will be wrong; give --mosaic auto, or correct the sidecar's cfa"
            )

    def _given(self, view: View) -> tuple[Array, Array] | None:
        poses = self.options.poses
        if poses is None:
            return None
        frames = poses.times_s * self.sensor.frame_rate_hz
        near = min(max(int(np.searchsorted(frames, view.time)), 1), len(frames) - 1)
        around = slice(max(0, near - 2), near + 2)
        spline = Spline.fit(frames[around], poses.rotations[around], poses.centres[around], 1e9, degree=1)
        rotation, centre = spline.poses([view.time])
        return rotation[0], centre[0]

    def _thin(self) -> None:
        """Let go of every second of the older half of the views."""
        half = len(self._views) // 2
        self._views = self._views[:half:2] + self._views[half:]
        self._queue = []
        self._mapper.forget_residuals()

    @property
    def path(self) -> Path | None:
        """The path so far in frames and map units; None before the bootstrap."""
        if not self._odometry.sparse:
            return self._refined or self._odometry.spline
        if self._strung != self._version:
            self._waypoints, self._strung = self._odometry.waypoints(), self._version
        return self._waypoints

    def improve(self, seconds: float) -> None:
        """Map for about this long: seed the map where the camera has been, then gradient steps."""
        begin = time.perf_counter()
        if not self._ready():
            return
        self._follow_focal()
        self._stage = "mapping"
        if len(self._mapper.scene) == 0 or self._wants_seed():
            self._seed(self._newest_seed())
        while time.perf_counter() - begin < seconds:
            self._step(1.0, coarse=max(0.0, 1 - self._mapper.steps / YOUNG_STEPS))
        self._mapped = self.path
        self._spent["mapping"] += time.perf_counter() - begin
        self._note()

    def _ready(self) -> bool:
        return self.path is not None and len(self._mappable()) >= 10

    def _mappable(self) -> list[int]:
        """Views whose pose is known: inside the path, and seen while tracking was good."""
        path = self.path
        if path is None:
            return []
        good = {v.time for v in self._odometry.views if v.rotation is not None and v.state is not State.LOST}
        return [i for i, v in enumerate(self._views) if path.begin <= v.time <= path.end and v.time in good]

    def _wants_seed(self) -> bool:
        times = [self._views[i].time for i in self._mappable()]
        return len(times) > 12 and times[-1] - self._seeded[-1] > 0.3 * (times[-1] - times[0])

    def _newest_seed(self) -> list[int]:
        usable = self._mappable()
        return [usable[len(usable) // 2]] if len(self._mapper.scene) == 0 else [usable[-3]]

    def _seed(self, numbers: list[int]) -> None:
        """Sweep depth at some views and fill what the map does not cover."""
        path, usable = self.path, self._mappable()
        assert path is not None and self.sensor.intrinsics is not None
        rotations, centres = path.poses([self._views[i].time for i in usable])
        points = self._odometry.points[np.isfinite(self._odometry.points[:, 0])]
        doubtful, depths, begins = [], [], len(self._mapper.scene) == 0
        for number in numbers:
            reference = usable.index(number)
            depth = (points - centres[reference]) @ rotations[reference][:, 2]
            if (depth > 0).sum() < 10:
                continue
            low, high = np.percentile(1 / depth[depth > 0], [1, 99.5])
            self._depth = float(np.median(depth[depth > 0]))
            depths.append(self._depth)
            view = self._views[number]

            def shot(row: int) -> Shot:
                image = luminance(self._views[usable[row]].rate, self.sensor.mosaic)
                return Shot(image, rotations[row], centres[row])

            others = [shot(r) for r in neighbours(centres, rotations[:, :, 2], reference, SWEEP_NEIGHBOURS)]
            # A quarter of the pixels takes a tenth of a second, in which a fast camera is not lost.
            pixels = SWEPT_PIXELS // 4 if self._odometry.sparse else SWEPT_PIXELS
            planes = (1.3 * high, 0.5 * low)
            noise = 1.5 * view.deviation
            swept = sweep(shot(reference), others, self.sensor.intrinsics, planes, noise, pixels, self.options.threads)
            self._mapper.seed_from(view, rotations[reference], centres[reference], swept, SURE_DEPTH)
            doubtful.append((view, rotations[reference], centres[reference], swept))
            self._seeded.append(view.time)
        for seen in doubtful:
            self._mapper.seed_from(*seen)
        if begins and depths:
            self._mapper.depth = float(np.median(depths))
        self._version += 1

    def _step(self, decay: float, densify: bool = True, coarse: float = 0.0) -> None:
        """One gradient step on the next view of a random order."""
        path = self.path
        assert path is not None
        if not self._queue:
            self._queue = [int(i) for i in self._rng.permutation(self._mappable())]
        view = self._views[number := self._queue.pop()]
        level = self._mapper.level(coarse)
        sight = self._passing(view, path) or self._sight(view, path, level.factor)
        self._mapper.step(number, view, sight, decay, level)
        if densify and self._mapper.steps % DENSIFY_EVERY == 0:
            self._mapper.densify(number, view, sight)
        self._version += self._mapper.steps % 20 == 0

    def _sight(self, view: View, path: Path, pixel: int = 1) -> Sight:
        """The camera's way during a view, in pieces over which the image moves little; pixels may be larger ones."""
        parts = self.options.mapping.sub_frames
        if parts == 0:
            rotations, centres = path.poses([view.time])
            return Sight(rotations, centres)
        if parts is None:
            times, _, _ = view.exposure(1)
            parts = int(np.clip(np.ceil(self._motion(path, times) / (SUB_FRAME_PX * pixel)), 1, MAX_SUB_FRAMES))
        times, windows, seen = view.exposure(parts)
        rotations, centres = path.poses(np.clip(times, path.begin, path.end))
        return Sight(rotations, centres, windows, seen)

    def _passing(self, view: View, path: Path) -> Sight | None:
        """A view of fast motion: one pose, and the frames around it that the path covers."""
        if view.frames is None:
            return None
        times = view.first + 0.5 + np.arange(len(view.frames))
        covered = (times >= path.begin) & (times <= path.end)
        rotations, centres = path.poses(np.append(times[covered], view.time))
        passage = Passage(view.frames[covered], rotations[:-1], centres[:-1])
        return Sight(rotations[-1:], centres[-1:], passage=passage)

    def _motion(self, path: Path, times: Array) -> float:
        """How far the image moves between two times at a typical place, in pixels."""
        rotations, centres = path.poses(np.clip(times, path.begin, path.end))
        return self._apart(rotations[0], centres[0], rotations[-1], centres[-1])

    def _apart(self, rotation: Array, centre: Array, other: Array, other_centre: Array) -> float:
        """How far the image moves between two poses at a typical place, in pixels."""
        k = self.camera.intrinsics
        at = np.array([[x, y] for x in (0.15, 0.5, 0.85) for y in (0.15, 0.5, 0.85)]) * [
            self.camera.width,
            self.camera.height,
        ]
        rays = np.column_stack([(at - [k.cx, k.cy]) / [k.fx, k.fy], np.ones(len(at))])
        there = (rays * self._depth @ rotation.T + centre - other_centre) @ other
        moved = there[:, :2] / np.maximum(there[:, 2:], 1e-3) * [k.fx, k.fy] + [k.cx, k.cy] - at
        return float(np.percentile(np.linalg.norm(moved, axis=1), 75))

    def finish(
        self,
        progress: Callable[[Status], None] | None = None,
        cancelled: Callable[[], bool] = lambda: False,
        budget_s: float | None = None,
    ) -> None:
        """Use what is left in the buffers and refine path and map together.

        Where the steps of the options take longer than `budget_s`, fewer are taken, from coarse to settled all the
        same. Stops early when `cancelled` says so.
        """
        begin = time.perf_counter()
        deadline = np.inf if budget_s is None else begin + budget_s
        with self._one_blas_thread():
            for view in self._windows.flush():
                self._add(view)
            if self.options.poses is None:
                self._odometry.end()
            else:
                self._take_given_poses()
        error = self._odometry.path_error
        if error is not None and error > WORST_PATH_ERROR:
            self.warnings.append(
                f"the shape of the whole path is only known to about {error:.0%}, before the map corrects it: "
                "few tracks tie its parts together; more sideways motion, slower motion or more light would help"
            )
        self._spent["tracking"] += time.perf_counter() - begin
        begin = time.perf_counter()
        if self._ready():
            self._refine(progress, cancelled, deadline)
        self._spent["refining"] += time.perf_counter() - begin
        self._stage = "done"
        if progress:
            progress(self.status())

    def _take_given_poses(self) -> None:
        poses = self.options.poses
        assert poses is not None
        self._odometry.triangulate_all()
        points = self._odometry.points[np.isfinite(self._odometry.points[:, 0])]
        frames = poses.times_s * self.sensor.frame_rate_hz
        span = (0.0, float(self._frames))
        spline = Spline.fit(frames, poses.rotations, poses.centres, 8, span=span)
        middle = spline.poses([0.5 * self._frames])
        depth = (points - middle[1][0]) @ middle[0][0][:, 2]
        if (depth > 0).sum() < 10:
            self._odometry.reason = "the given poses do not explain the tracks: no point could be triangulated"
            return
        self._unit = float(np.median(depth[depth > 0]))
        self._odometry.points = self._odometry.points / self._unit
        self._odometry.spline = replace(spline, centres=spline.centres / self._unit)

    def _refine(
        self, progress: Callable[[Status], None] | None, cancelled: Callable[[], bool], deadline: float
    ) -> None:
        begin = time.perf_counter()
        self._stage = "refining"
        self._follow_focal()
        if self.focal is not None:
            self.warnings.append(f"{self.focal}: give --fov or --intrinsics if you know it")
        usable = self._mappable()
        if self._stale():
            self._mapper = self._new_mapper()
        self._queue = []
        order = np.linspace(0, len(usable) - 1, SEED_VIEWS).round().astype(int)
        self._seed([usable[i] for i in order[np.argsort(np.abs(order - order.mean()))]])
        steps, aligned = self._steps(), 0
        known = self._known() if self._aligns() else None
        seeded = time.perf_counter()
        available_s = max(deadline - seeded, 1e-9)
        for done in range(steps):
            share = max(done / steps, (time.perf_counter() - seeded) / available_s)
            if share >= 1 or cancelled():
                break
            coarse = max(0.0, 1 - share / COARSE_SHARE)
            decay = 10**-share * min(1.0, (1 - share) / SETTLING_SHARE)
            self._step(decay, densify=share < 0.7, coarse=coarse)
            due = min(ALIGNMENTS, int(ALIGNMENTS * share / ALIGNED_SHARE))
            if due > aligned and self._aligns():
                aligned = due
                self._align(known, 2 / (1 + aligned))  # ever less of it: an unsettled map makes the path a random walk
            if done % 50 == 49:
                self._progress = max(share, (done + 1) / steps)
                self._note(time.perf_counter() - begin)
                if progress:
                    progress(self.status())
        self._version += 1

    def _stale(self) -> bool:
        """Whether the path has left the one that the map was made along: such a map would hold it where it was."""
        old, new = self._mapped, self.path
        if old is None or new is None:
            return False
        times = [v.time for v in (self._views[i] for i in self._mappable()) if old.begin <= v.time <= old.end]
        if not times:
            return True
        poses = zip(*old.poses(times), *new.poses(times), strict=True)
        return float(np.percentile([self._apart(*both) for both in poses], 90)) > STALE_PX

    def _steps(self) -> int:
        """Steps of the refinement: fewer for large images, more where the motion is fast."""
        pixels = self.camera.width * self.camera.height
        share = min(1.0, float((SMALL_PIXELS / pixels) ** LARGE_POWER))
        fast = float(np.mean([self._views[i].frames is not None for i in self._mappable()]))
        return round(self.options.steps * share * (1 + (FAST_STEPS - 1) * fast))

    def _aligns(self) -> bool:
        return self.options.refine_poses and self.options.poses is None and isinstance(self.path, Spline)

    def _known(self) -> Known | None:
        """The path as the tracks have it, before the map moves it."""
        tracked, information = self._odometry.spline, self._odometry.information()
        return None if tracked is None or information is None else Known(tracked, information)

    def _align(self, known: Known | None, share: float) -> None:
        spline = self.path
        assert isinstance(spline, Spline)
        numbered = [(i, self._views[i]) for i in self._mappable()]
        every = -(-len(numbered) // ALIGNED_VIEWS)
        pixel = self._mapper.alignment_level.factor
        self._refined = align_spline(
            spline,
            numbered[::every],
            self._mapper,
            lambda view: self._passing(view, spline) or self._sight(view, spline, pixel),
            known,
            share,
        )

    def _note(self, running_s: float = 0.0) -> None:
        """Add the loss to the curve over seconds of work; `running_s` are not counted as spent yet."""
        loss = self._mapper.loss
        if loss is not None:
            self._curve.append((sum(self._spent.values()) + running_s, float(-10 * np.log10(loss))))

    def status(self) -> Status:
        """Where the work stands."""
        o, m = self._odometry, self._mapper
        last = next((v for v in reversed(o.views) if v.rotation is not None), None)
        pose = (last.inliers, last.chi2, last.sigma_px) if last is not None else (None, None, None)
        done = self._progress
        reason = o.reason if self.focal is None or o.spline is None else f"{o.reason}; {self.focal}"
        return Status(o.state, reason, self._stage, self._frames, len(m.scene), m.loss, self._version, done, *pose)

    def tracked(self, since: int = 0) -> list[Tracked]:
        """The views tracked so far, in order, without the first `since`."""
        new = self._odometry.views[since:]
        rates = {
            view.time: view.spikes_a_pixel / (view.end - view.begin) for view in self._views[-min(64, len(new) or 1) :]
        }
        return [
            Tracked(
                view.time,
                view.time / self.sensor.frame_rate_hz,
                view.state,
                view.rotation,
                None if view.centre is None else view.centre * self._unit,
                rates.get(view.time, 0.0),
                view.sigma_px,
                view.chi2,
            )
            for view in new
        ]

    def trajectory(self) -> Trajectory:
        """A pose for the middle of every frame whose surroundings were tracked; empty before the bootstrap."""
        path = self.path
        frames = np.arange(self._frames) + 0.5
        if path is None:
            return Trajectory(np.zeros(0), np.zeros((0, 3, 3)), np.zeros((0, 3)))
        frames = frames[(frames >= path.begin) & (frames <= path.end)]
        numbered = [(n, v) for n, v in enumerate(self._odometry.views) if v.rotation is not None]
        numbers = np.array([n for n, _ in numbered])
        times = np.array([v.time for _, v in numbered])
        reach = np.array([v.length for _, v in numbered])
        after = np.clip(np.searchsorted(times, frames), 1, len(times) - 1)
        near = np.where(np.abs(times[after - 1] - frames) < np.abs(times[after] - frames), after - 1, after)
        kept = np.abs(times[near] - frames) <= 1.5 * reach[near]
        for view in self._odometry.views:
            if view.rotation is None:  # it was looked at, and nobody knows where from
                kept &= np.abs(frames - view.time) > 0.5 * view.length
        if self._bridged:
            smooth = np.array([n in self._bridged for n in numbers]) & (np.diff(numbers, prepend=-2) == 1)
            kept |= smooth[after] & (frames > times[after - 1]) & (frames < times[after])
        frames = frames[kept]
        rotations, centres = path.poses(frames)
        return Trajectory(frames / self.sensor.frame_rate_hz, rotations, centres * self._unit)

    def scene(self) -> Scene:
        """A copy of the map as it is now, in the trajectory's unit."""
        scene = self._mapper.scene.select(np.arange(len(self._mapper.scene)))
        scene.means *= np.float32(self._unit)
        scene.log_scales += np.float32(np.log(self._unit))
        return scene

    @property
    def white(self) -> float:
        """The radiance (spikes a frame) that should be shown as white."""
        return self._mapper.white

    def view(self, rotation: Array, centre: Array) -> Image:
        """The map from a pose (camera-to-world, trajectory's unit): radiance [H, W, C], float32."""
        values = self._mapper.render(rotation, centre / self._unit)
        return values[..., None] if values.ndim == 2 else values

    def level(self, time_s: float) -> float:
        """The brightness of the image at a time, relative to the map's: flicker and lamps. 1 before any map."""
        if not self._views:
            return 1.0
        times = np.array([view.time for view in self._views]) / self.sensor.frame_rate_hz
        return self._mapper.nuisances.level(int(np.argmin(np.abs(times - time_s))))

    def samples(self, count: int = 4) -> list[Sample]:
        """Observed and rendered images at some times over the recording; empty before there is a map."""
        usable = self._mappable()
        if not usable or not len(self._mapper.scene):
            return []
        out = []
        for i in np.linspace(0, len(usable) - 1, count).round().astype(int):
            view = self._views[usable[i]]
            path = self.path
            assert path is not None
            rotation, centre = path.poses([view.time])
            observed = fill_mosaic(view.rate, self._mapper.channels)
            rendered = self._mapper.render(rotation[0], centre[0])
            rendered = rendered[..., None] if rendered.ndim == 2 else rendered
            out.append(Sample(view.time / self.sensor.frame_rate_hz, observed, rendered))
        return out

    def report(self) -> dict[str, object]:
        """Versions, parameters, states with reasons, timings and gaps, ready for JSON."""
        try:
            release = version("spiked")
        except PackageNotFoundError:
            release = "unknown"
        rate = self.sensor.frame_rate_hz
        odometry = self._odometry
        options = asdict(replace(self.options, poses=None, calibration=None)) | {
            "poses": self.options.poses is not None,
            "calibration": self.options.calibration is not None,
        }
        return {
            "versions": {"spiked": release, "python": platform.python_version()}
            | {name: version(name) for name in ("numpy", "opencv-python-headless")},
            "path_error_predicted": odometry.path_error,
            "focal_px": [self.camera.intrinsics.fx, self.camera.intrinsics.fy],
            "focal_estimated": self.focal is not None,
            "focal_relative_sigma": None if self.focal is None else _finite(self.focal.relative_sigma),
            "sensor": {"width": self.sensor.width, "height": self.sensor.height, "frame_rate_hz": rate},
            "options": options,
            "frames": self._frames,
            "gaps": [{"first_frame": f, "frames": n} for f, n in self._gaps],
            "state": str(odometry.state),
            "reason": odometry.reason,
            "warnings": list(self.warnings),
            "states": [{"time_s": t / rate, "state": str(s), "reason": r} for t, s, r in odometry.changes],
            "views": [
                {
                    "time_s": v.time / rate,
                    "frames": v.length,
                    "motion_px": round(v.motion_px, 3),
                    "inliers": round(v.inliers, 3),
                    "chi2": None if v.chi2 is None else round(v.chi2, 3),
                    "sigma_px": None if v.sigma_px is None else round(v.sigma_px, 4),
                    "state": str(v.state),
                }
                for v in odometry.views
            ],
            "knot_spacing_frames": self.path.spacing if isinstance(self.path, Spline) else None,
            "splats": len(self._mapper.scene),
            "steps": self._mapper.steps,
            "loss": self._mapper.loss,
            "psnr_of_views_over_seconds": [[round(s, 2), round(p, 2)] for s, p in self._curve],
            "seconds": {k: round(s, 3) for k, s in (self._spent | {"total": sum(self._spent.values())}).items()},
            "correction_deg": self._correction(),
        }

    def _correction(self) -> float | None:
        """How far the map turned the path of the sparse tracks, RMS in degrees."""
        if self._refined is None or self._odometry.spline is None:
            return None
        times = np.array([v.time for v in self._odometry.views if v.rotation is not None])
        a, _ = self._refined.poses(times)
        b, _ = self._odometry.spline.poses(times)
        return float(np.degrees(np.sqrt((log_so3(a @ b.swapaxes(1, 2)) ** 2).sum(1).mean())))


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None
