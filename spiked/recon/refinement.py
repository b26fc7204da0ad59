"""`Refinement`: path and map together after the last frame, by the method of the options."""

from collections.abc import Callable

from spiked.recon.alternation import Alternator
from spiked.recon.mapping.pose_alignment import TrajectoryPrior
from spiked.recon.mapping.pose_steps import GaussNewton, PoseGradient, PoseStep
from spiked.recon.mapping.trainer import MapTrainer
from spiked.recon.methods import PoseStepName
from spiked.recon.odometry.long_paths import LONG_FRAMES
from spiked.recon.odometry.self_calibration import optics_moved
from spiked.recon.options import Options
from spiked.recon.refiner import Refiner, plan_of
from spiked.recon.report import WorkLog
from spiked.recon.time_left import Part, TimeLeft
from spiked.recon.untracked import UntrackedOdometry
from spiked.recon.view_tracking import LEAST_VIEWS, ViewTracker
from spiked.spline import Path


class Refinement:
    """Fits map and path to the views of a tracker, and knows what work is left."""

    def __init__(
        self, tracker: ViewTracker, trainer: MapTrainer, options: Options, log: WorkLog, time_left: TimeLeft
    ) -> None:
        """`log` and `time_left` measure the work."""
        self._tracker, self._trainer, self._options = tracker, trainer, options
        self._log, self._time_left = log, time_left
        self._schedule: Refiner | Alternator | None = None
        """None before the refinement has begun."""
        self._from_s = 0.0
        """Work before the refinement, in seconds."""
        self.progress = 0.0
        """Share that is done, 0 to 1."""
        self.ended = 0
        """Number of refinements that have ended: each changes the path."""

    @property
    def path(self) -> Path | None:
        """The path so far in frames and map units, corrected by the map once that has begun; None before the
        bootstrap."""
        return self._tracker.path if self._schedule is None else self._schedule.path

    @property
    def mappable_path(self) -> Path | None:
        """The path, once there are enough views for a map."""
        path = self.path
        return path if len(self._tracker.views.mappable(path)) >= LEAST_VIEWS else None

    @property
    def aligned(self) -> bool:
        """Whether the path was aligned with the map, with the tracked one as the prior."""
        return self._schedule is not None and self._schedule.aligned > 0

    @property
    def optics_moved(self) -> bool:
        """Whether focal length or distortion changed by more than their tolerance since the map was begun."""
        return optics_moved(self._trainer.camera.intrinsics, self._tracker.odometry.intrinsics)

    def run(
        self,
        progress: Callable[[], None],
        cancelled: Callable[[], bool],
        deadline: float,
        save: Callable[[], None],
    ) -> None:
        """Refine, or go on after a checkpoint; without a path that can be mapped nothing is done.

        The arguments are those of `Reconstructor.finish`; `deadline` is a time of `time.perf_counter`.
        """
        if self._schedule is None:
            if (path := self.mappable_path) is None or not self._prepare(progress, cancelled):
                return
            self._schedule = self._make_schedule(path)
            self._from_s = self._log.total_s
        for share in self._schedule.run(self._options.steps, deadline, cancelled, save):
            self.progress = share
            self._log.note(self._trainer.mapper.loss)
            progress()
        if isinstance(self._tracker.odometry, UntrackedOdometry):
            self._tracker.odometry.follow(self._schedule.path)
        self.ended += 1

    def _prepare(self, progress: Callable[[], None], cancelled: Callable[[], bool]) -> bool:
        """Warn of what was estimated, and take the final optics; returns whether to go on."""
        tracker, trainer = self._tracker, self._trainer
        for estimate in tracker.estimated:
            tracker.warnings.append(f"{estimate}: {estimate.ADVICE}")
        if len(trainer.mapper) and not self.optics_moved:
            progress()  # the live map, before it may be rebuilt
            if cancelled():
                return False  # a rebuilt map without refinement would be worse
        if tracker.odometry.intrinsics != trainer.camera.intrinsics:
            trainer.restart(tracker.odometry.intrinsics)
        return True

    def _make_schedule(self, path: Path) -> Refiner | Alternator:
        """What fits map and path, by the method."""
        options, tracker, trainer = self._options, self._tracker, self._trainer
        parts, pose_step = options.parts, None
        if tracker.given is None and (options.refine_poses or tracker.untracked):
            pose_step = self._make_pose_step(parts.pose_step)
        if parts.alternation is None:
            return Refiner(trainer, path, tracker.points, pose_step, self._time_left)
        return Alternator(
            trainer, path, tracker.points, pose_step, parts.alternation, tracker.untracked, options.first_depth
        )

    def _make_pose_step(self, name: PoseStepName) -> PoseStep:
        if name is not PoseStepName.ALIGNMENT:
            return PoseGradient(self._trainer, self._options.seed, difference=name is PoseStepName.DIFFERENCE)
        free = self._options.parts.alternation is not None  # it takes knots of its own
        return GaussNewton(self._trainer, None if free else self._prior())

    def _prior(self) -> TrajectoryPrior | None:
        """The tracked path with its information, as the prior of the alignment."""
        odometry = self._tracker.odometry
        tracked, information = odometry.spline, odometry.information()
        if tracked is None or information is None:
            return None
        return TrajectoryPrior(tracked.rotations, tracked.centres, information)

    @property
    def left_s(self) -> float | None:
        """Predicted seconds to the end of `Reconstructor.finish`; None while they are not known."""
        left_s = self._time_left.told(self._work_left)
        if isinstance(self._schedule, Alternator) and 0 < self.progress < 1:  # as fast as so far
            left_s = (self._log.total_s - self._from_s) * (1 / self.progress - 1)
        return left_s

    def _work_left(self) -> dict[Part, float] | None:
        """The work that is left, while it is known how many frames come."""
        options, tracker = self._options, self._tracker
        expected, now = self._time_left.frames, max(tracker.frames, 1)
        if isinstance(self._schedule, Refiner) and (left := self._schedule.left) is not None:
            return left
        if expected is None or options.parts.alternation is not None:
            return None
        tracking: dict[Part, float] = {}
        travelled_px = tracker.views.travelled_px
        if not tracker.ended:
            tracking = self._time_left.tracking(tracker.odometry.long, travelled_px / now, tracker.sensor)
            travelled_px *= max(expected / now, 1.0)
        long = tracker.odometry.sparse or expected > LONG_FRAMES
        align = options.refine_poses and tracker.given is None
        plan = plan_of(self._trainer, options.steps, tracker.views.kept, travelled_px, align, long)
        return {**tracking, **plan.work(None, 0)}
