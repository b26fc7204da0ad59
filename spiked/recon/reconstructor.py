"""`Reconstructor`: frames in, trajectory and scene out at any time."""

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from spiked.errors import ConfigurationError
from spiked.pose import Array
from spiked.recon.blas import one_blas_thread
from spiked.recon.frontend.recorded_views import RecordedFrames
from spiked.recon.mapping.loss import LossName
from spiked.recon.mapping.trainer import MapTrainer
from spiked.recon.odometry.odometry import Odometry
from spiked.recon.odometry.self_calibration import FIRST_DEG, Focal
from spiked.recon.options import Options
from spiked.recon.refinement import Refinement
from spiked.recon.report import WorkLog
from spiked.recon.results import Results
from spiked.recon.status import Sample, Status, Tracked
from spiked.recon.time_left import TimeLeft
from spiked.recon.view_store import ViewStore
from spiked.recon.view_tracking import ViewTracker
from spiked.render import Camera
from spiked.scene import Scene
from spiked.sensor import Image, Intrinsics, Response, Sensor
from spiked.spline import Path
from spiked.trajectory import Trajectory


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
        self._live = live
        _check(sensor, options)
        intrinsics = sensor.intrinsics or Intrinsics.from_fov(sensor.width, sensor.height, FIRST_DEG)
        focal = Focal(intrinsics, np.inf) if sensor.intrinsics is None else None
        self._tracker = ViewTracker(sensor, intrinsics, focal, options, live, recording)
        self.odometry: Odometry = self._tracker.odometry
        """The tracker: its views, points and states."""
        self.views: ViewStore = self._tracker.views
        """One record a view."""
        self.warnings: list[str] = self._tracker.warnings
        """Warnings about the recording, one sentence each."""
        known = replace(sensor, intrinsics=intrinsics)
        self.trainer = MapTrainer(known, self.views, options.fitted, options.seed, options.threads, options.calibration)
        """The training of the map."""
        self._log, self._time_left = WorkLog(), TimeLeft()
        self._refinement = Refinement(self._tracker, self.trainer, options, self._log, self._time_left)
        self._results = Results(self._tracker, self.trainer, self._refinement, options, self._log)
        self._stage = "waiting"

    @property
    def frames(self) -> int:
        """Frames so far, lost ones included: the index at which the next ones begin."""
        return self._tracker.frames

    @property
    def waiting_frames(self) -> tuple[int, NDArray[np.uint8]]:
        """Index of the first of the fed frames that later views still need, and these, uint8 [n, frame_bytes]."""
        return self._tracker.windows.waiting

    @property
    def tracking_ended(self) -> bool:
        """All frames are tracked, and the path is final up to its alignment with the map."""
        return self._tracker.ended

    @property
    def tracking_parts(self) -> tuple[object, ...]:
        """Parts that do not change after the tracking, for a checkpoint."""
        return self._tracker.odometry, self._tracker.views, self._tracker.windows

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
        return self.trainer.sensor

    @property
    def unit(self) -> float:
        """Length of the map's unit in the trajectory's unit: 1 unless poses were given."""
        return self._tracker.unit

    @property
    def camera(self) -> Camera:
        """The camera of the map."""
        return self.trainer.camera

    @property
    def focal(self) -> Focal | None:
        """The estimated focal length; None if it was given."""
        return self.odometry.focal

    @property
    def latest_frames(self) -> int:
        """Number of frames that the next `track_latest` needs."""
        return self._tracker.windows.latest_frames

    @property
    def speed_px(self) -> float | None:
        """Image motion in px a frame between the two newest views; None without tracks."""
        return self._tracker.speed_px

    def feed(self, first_frame: int, frames: NDArray[np.uint8]) -> None:
        """Add stored frames uint8 [n, frame_bytes] that begin at absolute index `first_frame`."""
        self._time_left.start()
        before = len(self.views)
        with self._log.measure("tracking"), one_blas_thread():
            self._after_tracking(self._tracker.feed(first_frame, frames))
        self._time_left.tracked(self.frames, len(self.views), len(self.views) - before, self._tracker.sensor)

    def expect(self, frames: int) -> None:
        """Say how many frames will have been fed before `finish`, for `Status.left_s`."""
        self._time_left.expect(frames)

    def track_latest(self, first_frame: int, frames: NDArray[np.uint8]) -> None:
        """Skip backlog: track one view in the middle of stored frames, uint8 [n, frame_bytes], not those before.

        For tracking that cannot keep up with the camera. Over up to `view_tracking.BRIDGED_S` the path is interpolated.
        """
        with self._log.measure("tracking"), one_blas_thread():
            self._after_tracking(self._tracker.track_latest(first_frame, frames))

    def _after_tracking(self, dropped: bool) -> None:
        """`dropped`: images of views were dropped."""
        if dropped:
            self.trainer.forget_views()
        if self._stage == "waiting" and len(self.views):
            self._stage = "tracking"

    def gap(self, first_frame: int, count: int) -> None:
        """Frames [first_frame, first_frame + count) were lost."""
        self._tracker.gap(first_frame, count)

    @property
    def path(self) -> Path | None:
        """The path so far in frames and map units; None before the bootstrap."""
        return self._refinement.path

    def improve(self, seconds: float) -> None:
        """Map for about `seconds`: seed splats from recent views, then take gradient steps."""
        until, path = time.perf_counter() + seconds, self._refinement.mappable_path
        if path is None:
            return
        with self._log.measure("mapping"):
            if self._refinement.optics_moved:
                self.trainer.restart(self.odometry.intrinsics)
            self._stage = "mapping"
            self.trainer.train_live(path, self.odometry.points, until, behind=self._live)
        self._log.note(self.trainer.mapper.loss)

    def sweep_behind(self) -> None:
        """Seed splats from a view that another thread has swept: `improve` for a tracker without time to map."""
        if not self.trainer.sweep_due or self._refinement.optics_moved:
            return
        with self._log.measure("mapping"):
            if (path := self._refinement.mappable_path) is not None:
                self.trainer.sweep_behind(path, self.odometry.points)

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
        live map, the first `progress` call of the refinement precedes any change of it, but that it follows the path.
        `save` is called wherever a checkpoint can be taken: `finish` of its reconstructor goes on from there.
        """
        deadline = np.inf if budget_s is None else time.perf_counter() + budget_s
        self.expect(self.frames)
        self._time_left.start(deadline)

        def tell() -> None:
            if progress is not None:
                progress(self.status())

        if not self.tracking_ended:
            self.end_tracking(progress, lambda: cancelled() or time.perf_counter() > deadline, save)
            with self._log.measure("tracking"):
                self._after_tracking(self._tracker.choose_views(self.camera.intrinsics.fx))
            if self._tracker.ended:
                save()
        with self._log.measure("refining"):
            if self._refinement.mappable_path is not None:
                self._stage = "refining"
                self._refinement.run(tell, cancelled, deadline, save)
        self._stage = "done"
        tell()

    def end_tracking(
        self,
        progress: Callable[[Status], None] | None = None,
        cancelled: Callable[[], bool] = lambda: False,
        save: Callable[[], None] = lambda: None,
        preliminary: bool = False,
    ) -> None:
        """Track the buffered frames, close the loops and adjust the whole path: what `finish` begins with, and no more
        can be fed. The arguments are those of `finish`; `tracking_ended` unless cancelled. `preliminary`: with fewer
        keyframes, for a path that is soon computed again.
        """

        def saved() -> None:
            self._time_left.ended(self.odometry.end_left, self.odometry.long)
            save()
            if progress is not None:
                progress(self.status())

        with self._log.measure("tracking"), one_blas_thread():
            self._after_tracking(self._tracker.flush())
            self._tracker.end(cancelled, saved, preliminary)
            self._time_left.ended(0.0, self.odometry.long)
            self._tracker.warn_of_path()
        if self.path is not None:
            self.trainer.carry(self.path)
        self._tracker.ended = not cancelled()  # otherwise loops may be open

    @property
    def failure(self) -> str | None:
        """Why a finished reconstruction has no path; None if it has one, and before the end."""
        return self.odometry.reason if self._stage == "done" and self.path is None else None

    def status(self) -> Status:
        """Current progress and state."""
        o, m = self.odometry, self.trainer.mapper
        last = next((v for v in reversed(o.views) if v.rotation is not None), None)
        pose = (last.inliers, last.chi2, last.sigma_px) if last is not None else (None, None, None)
        reason = o.reason if o.spline is None else "; ".join(map(str, [o.reason, *self._tracker.estimated]))
        version = self._tracker.posed_views + self._refinement.ended + self.trainer.version
        left_s = 0.0 if self._stage == "done" else self._refinement.left_s
        share = self._refinement.progress
        status = Status(o.state, reason, self._stage, self.frames, len(m), m.loss, version, share, *pose)
        return replace(status, left_s=left_s)

    def tracked(self, since: int = 0) -> list[Tracked]:
        """The views tracked so far, in order, without the first `since`."""
        return self._results.tracked(since)

    def closures(self) -> list[tuple[float, float]]:
        """Closed loops so far: times (s) of an earlier view and of a later one that sees the same place again."""
        return self._results.closures()

    def trajectory(self) -> Trajectory:
        """Poses at the middle of every frame near a tracked view; empty before the bootstrap."""
        return self._results.trajectory()

    def trajectory_so_far(self) -> Trajectory:
        """`trajectory`; of a long path that is still tracked only the poses of its views: far fewer than its frames."""
        return self._results.trajectory_so_far()

    @property
    def posed_frames(self) -> int:
        """Number of poses of `trajectory`."""
        return len(self._results.posed_frames())

    def scene(self) -> Scene:
        """A copy of the map as it is now, in the trajectory's unit."""
        return self._results.scene()

    @property
    def white(self) -> float:
        """The radiance (spikes a frame) that should be shown as white."""
        return self.trainer.mapper.shown_white

    def view(self, rotation: Array, centre: Array) -> Image:
        """The map from a pose (camera-to-world, trajectory's unit): radiance [H, W, C], float32."""
        return self._results.view(rotation, centre)

    def scene_psnr_db(self, scene: Scene, trajectory: Trajectory, intrinsics: Intrinsics) -> float:
        """PSNR of a scene along a trajectory against the recording, to compare versions of a reconstruction."""
        return self._results.scene_psnr_db(scene, trajectory, intrinsics)

    def level(self, time_s: float) -> float:
        """Brightness of the image at a time relative to the map's (flicker, lamps); 1 before any map."""
        return self._results.level(time_s)

    def samples(self, count: int = 4) -> list[Sample]:
        """Observed and rendered images at times spread over the recording; without a map only observed ones."""
        return self._results.samples(count)

    def report(self) -> dict[str, object]:
        """Versions, machine, parameters, states with reasons, timings and gaps, ready for JSON."""
        return self._results.report(self.failure)

    # Names of earlier releases, deprecated: they go with the next release.
    glance, glance_frames, likeness_db = track_latest, latest_frames, scene_psnr_db


def _check(sensor: Sensor, options: Options) -> None:
    """Raises ConfigurationError where options and sensor do not go together."""
    if sensor.intrinsics is None and options.poses is not None:
        raise ConfigurationError(
            "the focal length is not known, and poses are given: give --fov DEGREES or --intrinsics fx,fy,cx,cy"
        )
    if options.targets and sensor.response is Response.BERNOULLI:
        raise ConfigurationError(
            f"the loss {options.fitted.loss} is of cameras that integrate light, and this one counts photons: "
            f"use the loss {LossName.CHARGE}"
        )
