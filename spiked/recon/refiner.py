"""The refinement: path and map together, after the last frame."""

from collections.abc import Callable, Iterator

from spiked.pose import Array
from spiked.recon.mapping.pose_steps import ALIGNED_VIEWS, LONG_ALIGNED_VIEWS, PoseStep
from spiked.recon.mapping.trainer import MapTrainer
from spiked.recon.run_progress import PROGRESS_STEPS, RunProgress
from spiked.recon.time_left import Part, RefinementPlan, TimeLeft
from spiked.spline import Path, Waypoints

GRADIENT_STEPS = 100
"""Steps of a pose step that goes along the gradient, in place of one alignment."""


def plan_of(
    trainer: MapTrainer, most_steps: int, ids: list[int], travelled_px: float, align: bool, long: bool
) -> RefinementPlan:
    """The refinement of a map to the views `ids` of a path of so much image motion, in at most `most_steps` steps for
    small images. On a `long` path the map is pruned."""
    options, camera = trainer.options, trainer.camera
    pixels, extent = camera.width * camera.height, trainer.extent_of(travelled_px)
    fast = trainer.fast_share(ids)
    return RefinementPlan(
        options.schedule.steps(most_steps, pixels, fast, extent),
        len(options.seeding.order(ids, extent)) if ids else 0,
        () if not align else options.schedule.align_long_at if long else options.schedule.align_at,
        min(len(ids), LONG_ALIGNED_VIEWS if long else ALIGNED_VIEWS),
        min(len(ids), options.pruning.views) if long else 0,
        pixels,
        trainer.mapper.cap_of(extent),
        trainer.sensor.mosaic is not None,
        trainer.mostly_fast(ids),
        options,
        trainer.threads,
    )


class Refiner:
    """Seeds and trains the map on the final path, and aligns the path with the map."""

    def __init__(
        self, trainer: MapTrainer, path: Path, points: Array, pose_step: PoseStep | None, clock: TimeLeft
    ) -> None:
        """points [N, 3] are landmarks on the tracked `path`.

        With a `pose_step` the path is corrected by the map. The `clock` measures the work.
        """
        self.path = path
        """The path, corrected so far."""
        self.aligned = 0
        """Number of alignments made."""
        self._prunes = isinstance(path, Waypoints)
        """On long paths: pruning costs short ones 0.2 to 0.5 dB (decision 21)."""
        self._pruned = 0
        self._trainer = trainer
        self._schedule = trainer.options.schedule
        self._points = points
        self._pose_step = pose_step
        self._clock = clock
        self._plan: RefinementPlan | None = None
        """None before the refinement has begun."""
        self._progress = RunProgress()

    def run(
        self,
        most_steps: int,
        deadline: float,
        cancelled: Callable[[], bool],
        save: Callable[[], None] = lambda: None,
    ) -> Iterator[float]:
        """Refine in at most `most_steps` steps for small images; yields the share that is done, every 50 steps.

        If the steps would end after `deadline`, a time of `time.perf_counter`, the schedule is compressed to fewer.
        `save` is called before each step: a refiner saved there goes on with that step.
        """
        self._clock.start(deadline)
        if self._plan is None:
            self._plan = self._begin(most_steps)
        plan, steps, progress = self._plan, self._plan.steps, self._progress
        for share in progress.shares(steps, deadline, cancelled, save):
            self._trainer.step(self.path, self._schedule.rate(share), self._schedule.coarseness(share), share)
            self._clock.lap(Part.STEPS, plan.step_s(share * steps, len(self._trainer.mapper)))
            self._align_if_due(share, plan)
            self._prune_if_due(share, plan)
            progress.done += 1
            if progress.done % PROGRESS_STEPS == 0:
                yield max(share, progress.done / steps)

    @property
    def left(self) -> dict[Part, float] | None:
        """Work that is left; None before the refinement has begun."""
        return None if self._plan is None else self._plan.work(self._progress.done, len(self._trainer.mapper))

    def _begin(self, most_steps: int) -> RefinementPlan:
        """Seed the map."""
        trainer = self._trainer
        if trainer.stale(self.path):
            trainer.restart()
        trainer.reshuffle()
        ids = trainer.views.mappable(self.path)
        plan = plan_of(trainer, most_steps, ids, trainer.views.travelled_px, self._pose_step is not None, self._prunes)
        trainer.seed(self.path, self._points, trainer.options.seeding.order(ids, trainer.extent))
        if self._prunes and len(trainer.mapper):
            trainer.mapper.limit_sizes()
        self._clock.lap(Part.SEEDING, plan.seeding_s())
        return plan

    def _prune_if_due(self, share: float, plan: RefinementPlan) -> None:
        due = self._trainer.options.pruning.due(share)
        if self._prunes and due > self._pruned:
            self._pruned = due
            work_s = plan.pruning_s(len(self._trainer.mapper))
            self._trainer.prune(self.path, self._points)
            self._clock.lap(Part.PRUNING, work_s)

    def _align_if_due(self, share: float, plan: RefinementPlan) -> None:
        due = plan.alignments_due(share)
        if due <= self.aligned or self._pose_step is None:
            return
        self.aligned = due
        ids = self._trainer.views.mappable(self.path)
        self.path = self._pose_step.improve(self.path, ids, GRADIENT_STEPS, share)
        self._clock.lap(Part.ALIGNING, plan.aligning_s(len(self._trainer.mapper)))
