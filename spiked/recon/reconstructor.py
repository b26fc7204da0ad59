"""`Reconstructor`: frames in, trajectory and scene out at any time."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from spiked.errors import ConfigurationError
from spiked.pose import Array
from spiked.recon import report
from spiked.recon.alternation import Alternator
from spiked.recon.blas import one_blas_thread
from spiked.recon.frontend.feature_tracks import Picture, picture, smoothed, white_of
from spiked.recon.frontend.mosaic_check import layout_warnings
from spiked.recon.frontend.recorded_views import RecordedFrames, RecordedViews
from spiked.recon.frontend.windowing import View, Windows, luminance
from spiked.recon.given_poses import GivenPoses
from spiked.recon.mapping.loss import LossName
from spiked.recon.mapping.pose_alignment import TrajectoryPrior
from spiked.recon.mapping.pose_steps import GaussNewton, PoseGradient, PoseStep
from spiked.recon.mapping.scene_psnr import COMPARED_VIEWS, scene_psnr_db
from spiked.recon.mapping.trainer import MapTrainer
from spiked.recon.methods import Initialisation, PoseStepName
from spiked.recon.odometry.keyframe_adjuster import LONG_FRAMES
from spiked.recon.odometry.keyframe_pictures import KeyframePictures
from spiked.recon.odometry.odometry import Odometry
from spiked.recon.odometry.self_calibration import FIRST_DEG, EstimatedLens, Focal, optics_moved
from spiked.recon.options import Options
from spiked.recon.refiner import Refiner, plan_of
from spiked.recon.report import Sample, Status, Tracked, WorkLog
from spiked.recon.time_left import Part, TimeLeft
from spiked.recon.untracked import UntrackedOdometry
from spiked.recon.view_choice import choose
from spiked.recon.view_store import ViewStore
from spiked.render import Camera, rasteriser_for
from spiked.scene import Scene
from spiked.sensor import Image, Intrinsics, Response, Sensor
from spiked.spline import Path, Waypoints
from spiked.trajectory import Trajectory

BRIDGED_S = 0.03
"""Longest time between views over which the path is interpolated: hand tremor has about 10 Hz."""
KEYFRAME_SHARE = 0.125
"""Share of `Options.memory_mb` for the images of keyframes: a byte a pixel, while those of views take three or more."""
LEAST_VIEWS = 10
"""Views with a pose that a map needs."""


class Reconstructor:
    """Feed frames with `feed` and `gap`, map in spare time with `improve`, and end with `finish`.

    Poses are camera-to-world; the length unit is the median depth of the first views, or the unit of given poses.
    """

    def __init__(
        self,
        sensor: Sensor,
        options: Options | None = None,
        *,
        live: bool = False,
        recording: RecordedFrames | None = None,
    ) -> None:
        """A sensor without intrinsics has its focal length estimated; `sensor` and `camera` follow it.

        `live`: the frames come from a live camera; reasons advise how to move it. `recording`: the frames that are fed,
        by the same indices: images beyond `Options.memory_mb` are built anew from it.

        Raises ConfigurationError when poses are given without intrinsics.
        """
        self.options = options = options or Options()
        if sensor.intrinsics is None and options.poses is not None:
            raise ConfigurationError(
                "the focal length is not known, and poses are given: give --fov DEGREES or --intrinsics fx,fy,cx,cy"
            )
        intrinsics = sensor.intrinsics or Intrinsics.from_fov(sensor.width, sensor.height, FIRST_DEG)
        focal = Focal(intrinsics, np.inf) if sensor.intrinsics is None else None
        targets = options.targets
        if targets and sensor.response is Response.BERNOULLI:
            raise ConfigurationError(
                f"the loss {options.fitted.loss} is of cameras that integrate light, and this one counts photons: "
                f"use the loss {LossName.CHARGE}"
            )
        recorded = None if recording is None else RecordedViews(recording, sensor, options.calibration, targets)
        memory_bytes = options.memory_mb * 2**20
        self.views = ViewStore(options.max_views, (1 - KEYFRAME_SHARE) * memory_bytes, recorded)
        """One record a view."""
        pictures = KeyframePictures(KEYFRAME_SHARE * memory_bytes, None if recording is None else _Pictures(self))
        self._untracked = options.parts.initialisation is Initialisation.PROGRESSIVE
        if self._untracked and sensor.intrinsics is None:
            raise ConfigurationError(
                f"the focal length is not known, and the initialisation {Initialisation.PROGRESSIVE} has no tracks to "
                "estimate it from: give --fov DEGREES or --intrinsics fx,fy,cx,cy"
            )
        made = UntrackedOdometry if self._untracked else Odometry
        self.odometry = made(intrinsics, options.seed, focal, live, pictures)
        """The tracker: its views, points and states."""
        self.warnings: list[str] = []
        """Warnings about the recording, one sentence each."""
        self._windows = Windows(sensor, options.window_frames, options.calibration, targets)
        known = replace(sensor, intrinsics=intrinsics)
        self._trainer = MapTrainer(
            known, self.views, options.fitted, options.seed, options.threads, options.calibration
        )
        self._given = None if options.poses is None else GivenPoses(options.poses, sensor.frame_rate_hz)
        self._refiner: Refiner | Alternator | None = None
        self._preview = np.empty((sensor.height, sensor.width), np.float32)
        self._gaps: list[tuple[int, int]] = []
        self._after_gap = True
        self._frames = 0
        self._path_version = 0
        self._waypoints: tuple[int, Path | None] = (-1, None)
        self._stage = "waiting"
        self._progress = 0.0
        self._unit = 1.0
        """Length of the map's unit in the trajectory's unit."""
        self._log = WorkLog()
        self._time_left = TimeLeft()
        self._refined_from_s = 0.0
        self.tracking_ended = False
        """All frames are tracked, and the path is final up to its alignment with the map."""

    def __getstate__(self) -> dict[str, object]:
        """For a checkpoint: without what is made anew."""
        return {name: value for name, value in vars(self).items() if name != "_preview"}

    def __setstate__(self, state: dict[str, object]) -> None:
        vars(self).update(state)
        self._preview = np.empty((self.sensor.height, self.sensor.width), np.float32)
        self.odometry.build_images_with(_Pictures(self))

    @property
    def frames(self) -> int:
        """Frames so far, lost ones included: the index at which the next ones begin."""
        return self._frames

    @property
    def waiting_frames(self) -> tuple[int, NDArray[np.uint8]]:
        """Index of the first of the fed frames that later views still need, and these, uint8 [n, frame_bytes]."""
        return self._windows.waiting

    @property
    def losses(self) -> list[tuple[float, float]]:
        """(seconds of work, loss of the map) over the reconstruction."""
        return self._log.losses

    @property
    def work_s(self) -> float:
        """Seconds of work so far."""
        return self._log.total_s

    @property
    def sensor(self) -> Sensor:
        """The sensor with the intrinsics of the map."""
        return self._trainer.sensor

    @property
    def trainer(self) -> MapTrainer:
        """The training of the map."""
        return self._trainer

    @property
    def unit(self) -> float:
        """Length of the map's unit in the trajectory's unit: 1 unless poses were given."""
        return self._unit

    @property
    def camera(self) -> Camera:
        """The camera of the map."""
        return self._trainer.camera

    @property
    def focal(self) -> Focal | None:
        """The estimated focal length; None if it was given."""
        return self.odometry.focal

    def feed(self, first_frame: int, frames: NDArray[np.uint8]) -> None:
        """Add stored frames uint8 [n, frame_bytes] that begin at absolute index `first_frame`."""
        self._time_left.start()
        before = len(self.views)
        with self._log.measure("tracking"), one_blas_thread():
            for view in self._windows.feed(first_frame, frames):
                self._track_spaced(view)
            self._frames = first_frame + len(frames)
        self._time_left.tracked(self._frames, len(self.views), len(self.views) - before, self._windows.sensor)

    def expect(self, frames: int) -> None:
        """Say how many frames will have been fed before `finish`, for `Status.left_s`."""
        self._time_left.expect(frames)

    @property
    def latest_frames(self) -> int:
        """Number of frames that the next `track_latest` needs."""
        return self._windows.latest_frames

    @property
    def speed_px(self) -> float | None:
        """Image motion in px a frame between the two newest views; None without tracks."""
        if len(self.views) < 2 or not self.views[-1].tracked.motion_px:
            return None
        return self.views[-1].tracked.motion_px / (self.views[-1].time - self.views[-2].time)

    def track_latest(self, first_frame: int, frames: NDArray[np.uint8]) -> None:
        """Skip backlog: track one view in the middle of stored frames, uint8 [n, frame_bytes], not those before.

        For tracking that cannot keep up with the camera. Over up to `BRIDGED_S` the path is interpolated.
        """
        with self._log.measure("tracking"), one_blas_thread():
            self.odometry.skip()
            self._track(self._windows.latest_view(first_frame, frames), skipped=True)
            self._frames = first_frame + len(frames)

    def gap(self, first_frame: int, count: int) -> None:
        """Frames [first_frame, first_frame + count) were lost."""
        self._gaps.append((first_frame, count))
        self._after_gap = True

    def _track_spaced(self, view: View) -> None:
        """Track a view; those of a long path have spaces between them."""
        if self._windows.spaced:
            self.odometry.skip()
        self._track(view, skipped=self._windows.spaced)
        self._windows.spaced = self.odometry.long

    def _track(self, view: View, skipped: bool = False) -> None:
        """Track a view and store it; with `skipped`, frames before it were left out."""
        image, intervals = self.picture(view), view.intervals if view.sharp is None else None
        known = None if self._given is None else self._given.at(view.time)
        tracked = self.odometry.add(view.time, view.end - view.begin, image, known, intervals, view.after_gap)
        since = np.inf if self._after_gap else view.time - self.views[-1].time
        self.views.add(view, tracked, bridged=skipped and since < BRIDGED_S * self.sensor.frame_rate_hz)
        self._after_gap = False
        if len(self.views) == 1:
            self.warnings += layout_warnings(self.sensor, view.rate)
        else:
            self._windows.follow(tracked.motion_px, view.time - self.views[-2].time)
        if self._stage == "waiting":
            self._stage = "tracking"
        self._path_version += tracked.rotation is not None
        if self.views.thin():
            self._trainer.forget_views()

    def picture(self, view: View) -> Picture:
        """The image [H, W] of a view that tracks are followed in, uint8."""
        sharp = view.sharp
        grey = luminance(view.preview_rate(self._preview), self.sensor.mosaic) if sharp is None else sharp
        if self.sensor.response is Response.BERNOULLI:
            grey = smoothed(grey, float(np.median(view.deviation)))
        return picture(grey, white_of(grey))

    def _warn(self, warning: str | None) -> None:
        if warning is not None:
            self.warnings.append(warning)

    @property
    def path(self) -> Path | None:
        """The path so far in frames and map units; None before the bootstrap."""
        if self._refiner is not None:
            return self._refiner.path
        if not self.odometry.sparse:
            return self.odometry.spline
        if self._waypoints[0] != len(self.views):
            self._waypoints = len(self.views), self.odometry.waypoints()
        return self._waypoints[1]

    def improve(self, seconds: float) -> None:
        """Map for about `seconds`: seed splats from recent views, then take gradient steps."""
        until, path = time.perf_counter() + seconds, self._mappable_path()
        if path is None:
            return
        with self._log.measure("mapping"):
            if self._optics_moved():
                self._trainer.restart(self.odometry.intrinsics)
            self._stage = "mapping"
            self._trainer.train_live(path, self._points(), until)
        self._log.note(self._trainer.mapper.loss)

    def _mappable_path(self) -> Path | None:
        """The path, once there are enough views for a map."""
        path = self.path
        return path if len(self.views.mappable(path)) >= LEAST_VIEWS else None

    def _points(self) -> Array:
        """The known landmarks [N, 3]."""
        return self.odometry.points[np.isfinite(self.odometry.points[:, 0])]

    def _optics_moved(self) -> bool:
        """Whether focal length or distortion changed by more than their tolerance since the map was begun."""
        return optics_moved(self.camera.intrinsics, self.odometry.intrinsics)

    def _estimated(self) -> list[Focal | EstimatedLens]:
        """What was estimated of the optics."""
        return [one for one in (self.odometry.focal, self.odometry.lens) if one is not None]

    def finish(
        self,
        progress: Callable[[Status], None] | None = None,
        cancelled: Callable[[], bool] = lambda: False,
        budget_s: float | None = None,
        save: Callable[[], None] = lambda: None,
    ) -> None:
        """Track the buffered frames and refine path and map together.

        If the steps of the options take longer than `budget_s`, the schedule is compressed to fewer steps. Stops when
        `cancelled` returns true, with the map of that moment; the loops of a long path may then be open. If there is a
        live map, the first `progress` call of the refinement precedes any change of it. `save` is called wherever a
        checkpoint can be taken: `finish` of its reconstructor goes on from there.
        """
        deadline = np.inf if budget_s is None else time.perf_counter() + budget_s
        progress = progress or (lambda status: None)
        self.expect(self._frames)
        self._time_left.start(deadline)
        if not self.tracking_ended:

            def stop() -> bool:
                return cancelled() or time.perf_counter() > deadline

            def saved() -> None:
                self._time_left.ended(self.odometry.end_left, self.odometry.long)
                save()
                progress(self.status())

            with self._log.measure("tracking"):
                self._end_tracking(stop, saved)
            if not stop():  # otherwise loops may be open
                self.tracking_ended = True
                save()
        with self._log.measure("refining"):
            if self._refiner is not None:
                self._continue_refining(self._refiner, progress, cancelled, deadline, save)
            elif (path := self._mappable_path()) is not None:
                self._refine(path, progress, cancelled, deadline, save)
        self._stage = "done"
        progress(self.status())

    def _end_tracking(self, stop: Callable[[], bool], save: Callable[[], None]) -> None:
        with one_blas_thread():
            for view in self._windows.flush():
                self._track_spaced(view)
            if self._given is None:
                self.odometry.end(stop, save)
                self._waypoints = -1, None  # the views have moved
            else:
                self._unit = self._given.end(self.odometry, self._frames)
        if isinstance(path := self.path, Waypoints):
            self._choose_views(path)
        self._time_left.ended(0.0, self.odometry.long)
        self._warn(report.path_warning(self.odometry.path_error))
        self._warn(self.odometry.remark)

    def _refine(
        self,
        path: Path,
        progress: Callable[[Status], None],
        cancelled: Callable[[], bool],
        deadline: float,
        save: Callable[[], None],
    ) -> None:
        self._stage = "refining"
        for estimate in self._estimated():
            self.warnings.append(f"{estimate}: {estimate.ADVICE}")
        if len(self._trainer.mapper.scene) and not self._optics_moved():
            progress(self.status())  # the live map, before it may be rebuilt
            if cancelled():
                return  # a rebuilt map without refinement would be worse
        if self.odometry.intrinsics != self.camera.intrinsics:
            self._trainer.restart(self.odometry.intrinsics)
        self._refiner = self._make_refiner(path)
        self._refined_from_s = self.work_s
        self._continue_refining(self._refiner, progress, cancelled, deadline, save)

    def _make_refiner(self, path: Path) -> Refiner | Alternator:
        """What fits map and path, by the method."""
        parts, pose_step = self.options.parts, None
        if self._given is None and (self.options.refine_poses or self._untracked):
            pose_step = self._make_pose_step(parts.pose_step)
        if parts.alternation is None:
            return Refiner(self._trainer, path, self._points(), pose_step, self._time_left)
        return Alternator(self._trainer, path, self._points(), pose_step, parts.alternation, self._untracked)

    def _make_pose_step(self, name: PoseStepName) -> PoseStep:
        if name is PoseStepName.GRADIENT:
            return PoseGradient(self._trainer, self.options.seed)
        return GaussNewton(self._trainer, None if self._untracked else self._prior())

    def _continue_refining(
        self,
        refiner: Refiner | Alternator,
        progress: Callable[[Status], None],
        cancelled: Callable[[], bool],
        deadline: float,
        save: Callable[[], None],
    ) -> None:
        for share in refiner.run(self.options.steps, deadline, cancelled, save):
            self._progress = share
            self._log.note(self._trainer.mapper.loss)
            progress(self.status())
        if isinstance(self.odometry, UntrackedOdometry):
            self.odometry.follow(refiner.path)
        self._path_version += 1

    def _choose_views(self, path: Path) -> None:
        """Fit the map to the views of a long path that add something."""
        views, focal_px = self.views.candidates(path), self.camera.intrinsics.fx
        chosen = choose(views, self.odometry.points, focal_px, self.options.max_views)
        if len(chosen) >= LEAST_VIEWS:
            self.views.keep(chosen)
            self._trainer.forget_views()

    def _prior(self) -> TrajectoryPrior | None:
        """The tracked path with its information, as the prior of the alignment."""
        tracked, information = self.odometry.spline, self.odometry.information()
        return None if tracked is None or information is None else TrajectoryPrior(tracked, information)

    @property
    def failure(self) -> str | None:
        """Why a finished reconstruction has no path; None if it has one, and before the end."""
        return self.odometry.reason if self._stage == "done" and self.path is None else None

    def status(self) -> Status:
        """Current progress and state."""
        o, m = self.odometry, self._trainer.mapper
        last = next((v for v in reversed(o.views) if v.rotation is not None), None)
        pose = (last.inliers, last.chi2, last.sigma_px) if last is not None else (None, None, None)
        reason = o.reason if o.spline is None else "; ".join(map(str, [o.reason, *self._estimated()]))
        version = self._path_version + self._trainer.version
        left_s = 0.0 if self._stage == "done" else self._time_left.told(self._work_left)
        if isinstance(self._refiner, Alternator) and 0 < self._progress < 1:  # as fast as so far
            left_s = (self.work_s - self._refined_from_s) * (1 / self._progress - 1)
        status = Status(
            o.state, reason, self._stage, self._frames, len(m.scene), m.loss, version, self._progress, *pose
        )
        return replace(status, left_s=left_s)

    def _work_left(self) -> dict[Part, float] | None:
        """The work that is left, while it is known how many frames come."""
        expected, now = self._time_left.frames, max(self._frames, 1)
        if isinstance(self._refiner, Refiner) and (left := self._refiner.left) is not None:
            return left
        if expected is None or self.options.parts.alternation is not None:
            return None
        tracking: dict[Part, float] = {}
        travelled_px = self.views.travelled_px
        if not self.tracking_ended:
            tracking = self._time_left.tracking(self.odometry.long, travelled_px / now, self.sensor)
            travelled_px *= max(expected / now, 1.0)
        long = self.odometry.sparse or expected > LONG_FRAMES
        align = self.options.refine_poses and self._given is None and not long
        plan = plan_of(self._trainer, self.options.steps, self.views.kept, travelled_px, align, long)
        return {**tracking, **plan.work(None, 0)}

    def tracked(self, since: int = 0) -> list[Tracked]:
        """The views tracked so far, in order, without the first `since`."""
        return [Tracked.of(record, self.sensor.frame_rate_hz, self._unit) for record in self.views.since(since)]

    def closures(self) -> list[tuple[float, float]]:
        """Closed loops so far: times (s) of an earlier view and of a later one that sees the same place again."""
        rate = self.sensor.frame_rate_hz
        return [(earlier / rate, later / rate) for earlier, later in self.odometry.closures]

    def trajectory(self) -> Trajectory:
        """Poses at the middle of every frame near a tracked view; empty before the bootstrap."""
        return self._poses_at(self._posed_frames())

    def trajectory_so_far(self) -> Trajectory:
        """`trajectory`; of a long path that is still tracked only the poses of its views: far fewer than its frames."""
        if self.tracking_ended or not self.odometry.long or self.path is None:
            return self.trajectory()
        return self._poses_at(np.array([view.time for view in self.views.since(0) if view.posed]))

    @property
    def posed_frames(self) -> int:
        """Number of poses of `trajectory`."""
        return len(self._posed_frames())

    def _posed_frames(self) -> Array:
        """Middles, in frames, of the frames near a tracked view."""
        if (path := self.path) is None:
            return np.zeros(0)
        begin, end = max(0, int(np.ceil(path.begin - 0.5))), min(self._frames, int(path.end + 0.5))
        frames = np.arange(begin, end, dtype=np.float64) + 0.5
        return frames[self.views.covered(frames)]

    def _poses_at(self, frames: Array) -> Trajectory:
        if (path := self.path) is None:
            return Trajectory(np.zeros(0), np.zeros((0, 3, 3)), np.zeros((0, 3)))
        rotations, centres = path.poses(frames)
        return Trajectory(frames / self.sensor.frame_rate_hz, rotations, centres * self._unit)

    def scene(self) -> Scene:
        """A copy of the map as it is now, in the trajectory's unit."""
        scene = self._trainer.mapper.scene
        scene = scene.select(np.arange(len(scene)))
        scene.means *= np.float32(self._unit)
        scene.log_scales += np.float32(np.log(self._unit))
        return scene

    @property
    def white(self) -> float:
        """The radiance (spikes a frame) that should be shown as white."""
        return self._trainer.mapper.white

    def view(self, rotation: Array, centre: Array) -> Image:
        """The map from a pose (camera-to-world, trajectory's unit): radiance [H, W, C], float32."""
        return self._trainer.mapper.render(rotation, centre / self._unit)

    def scene_psnr_db(self, scene: Scene, trajectory: Trajectory, intrinsics: Intrinsics) -> float:
        """PSNR of a scene along a trajectory against the recording, to compare versions of a reconstruction."""
        rasteriser = rasteriser_for(Camera(intrinsics, self.sensor.width, self.sensor.height), self.options.threads)
        views = [self.views.image(i, sharp=True) for i in self.views.spread(self.views.kept, COMPARED_VIEWS)]
        return scene_psnr_db(views, self.sensor, rasteriser, scene, trajectory)

    def level(self, time_s: float) -> float:
        """Brightness of the image at a time relative to the map's (flicker, lamps); 1 before any map."""
        nearest = self.views.nearest(time_s * self.sensor.frame_rate_hz)
        return 1.0 if nearest is None else self._trainer.mapper.nuisances.level(nearest)

    def samples(self, count: int = 4) -> list[Sample]:
        """Observed and rendered images at times spread over the recording; without a map only observed ones."""
        return report.samples(self.views, self._trainer.mapper, self.path, self.sensor.frame_rate_hz, count)

    def report(self) -> dict[str, object]:
        """Versions, machine, parameters, states with reasons, timings and gaps, ready for JSON."""
        sensor, mapper, odometry = self.sensor, self._trainer.mapper, self.odometry
        aligned = self._refiner is not None and self._refiner.aligned > 0
        return {
            "versions": report.versions(),
            "machine": report.machine(),
            "sensor": {"width": sensor.width, "height": sensor.height, "frame_rate_hz": sensor.frame_rate_hz},
            **report.optics_section(mapper, self.focal, self.odometry.lens),
            "options": report.options_section(self.options),
            "frames": self._frames,
            "gaps": [{"first_frame": f, "frames": n} for f, n in self._gaps],
            "outcome": "complete" if self.failure is None else "failed",
            "warnings": list(self.warnings),
            **report.tracking_section(odometry, self.views.since(0), sensor.frame_rate_hz),
            **report.path_section(self.path, odometry, aligned),
            "closures": report.closures_section(self.closures()),
            **report.map_section(mapper),
            **self._log.report(),
        }

    # Names of earlier releases, deprecated: they go with the next release.
    glance, glance_frames, likeness_db = track_latest, latest_frames, scene_psnr_db


@dataclass(frozen=True)
class _Pictures:
    """Builds the images of keyframes anew from the recording."""

    of: Reconstructor

    def holds(self, view_id: int) -> bool:
        return self.of.views.rebuildable(view_id)

    def build(self, view_id: int) -> Picture | None:
        view = self.of.views.rebuilt(view_id)
        return None if view is None else self.of.picture(view)
