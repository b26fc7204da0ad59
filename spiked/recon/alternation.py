"""The schedule of Nope-SGS: poses and scene in turn, on key frames, with views that are added one by one."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from enum import Enum, auto

import numpy as np

from spiked.errors import ConfigurationError
from spiked.pose import Array, exp_so3, log_so3
from spiked.recon.mapping.loss import LossName
from spiked.recon.mapping.pose_steps import PoseStep
from spiked.recon.mapping.trainer import MapTrainer
from spiked.recon.methods import Alternation
from spiked.recon.run_progress import PROGRESS_STEPS, RunProgress
from spiked.sensor import Image
from spiked.spline import Path, Spline

LEAST_STEPS = 3
"""Steps for each view that is added, one of them of its pose."""
LEAST_KNOT_FRAMES = 8.0
"""Least spacing of the knots of a path."""
FLAT_DEPTH = 1.0
"""Depth of the first splats, the median if it is given, where the path grows with the map: it is the unit of length."""


class _Kind(Enum):
    SCENE = auto()
    """Scene steps."""
    POSE = auto()
    """Pose steps."""
    ADD = auto()
    """Add the next view, at constant velocity."""
    WHOLE = auto()
    """From now on steps are taken on all views."""
    SELECT = auto()
    """Choose key frames."""


_Action = tuple[_Kind, int]
"""What is done, and how many steps of it."""


class Alternator:
    """In place of `Refiner`: fits map and path in turn, see `Alternation`."""

    aligned = 0
    """Alignments with a tracked path as the prior: none."""

    def __init__(
        self,
        trainer: MapTrainer,
        path: Path,
        points: Array,
        pose_step: PoseStep | None,
        options: Alternation,
        progressive: bool,
        first_depth: Array | None = None,
    ) -> None:
        """points [N, 3] are landmarks on `path`. Without a `pose_step` the path is not changed; `progressive`: nothing
        is known of the path, a linear spline, and views are added one by one, from the first at `first_depth` [H, W]
        in any unit, or flat."""
        self.path = path
        """The path so far."""
        self._trainer = trainer
        self._points = points
        self._pose_step = pose_step
        self._options = options
        self._progressive = progressive
        self._first_depth = first_depth
        self._used: list[int] = []
        self._keys: list[int] = []
        self._growing = progressive
        self._plan: list[_Action] | None = None
        self._next = 0
        """Number of the action that comes next."""
        self._progress = RunProgress()

    def run(
        self,
        most_steps: int,
        deadline: float,
        cancelled: Callable[[], bool],
        save: Callable[[], None] = lambda: None,
    ) -> Iterator[float]:
        """As `Refiner.run`; `most_steps` counts pose steps and scene steps."""
        if self._plan is None:
            self._plan = self._begin(most_steps)
        plan, progress, reported = self._plan, self._progress, self._progress.done
        total = _steps_of(plan)
        for share in progress.shares(total, deadline, cancelled, save):
            self._act(*plan[self._next], share)
            self._next += 1
            if progress.done - reported >= PROGRESS_STEPS:
                reported = progress.done
                yield max(share, progress.done / total)
        self._trainer.use_only(None)

    def _begin(self, most_steps: int) -> list[_Action]:
        """Make the first splats; returns what is to be done."""
        trainer, ids = self._trainer, self._trainer.views.mappable(self.path)
        fast = trainer.fast_share(ids)
        pixels = trainer.camera.width * trainer.camera.height
        steps = trainer.options.schedule.steps(most_steps, pixels, fast, trainer.extent)
        if not self._progressive:
            if self._pose_step is not None and isinstance(self.path, Spline):
                self.path = through_views(self.path, [trainer.views[i].time for i in ids])
            if trainer.stale(self.path):
                trainer.restart()
            trainer.seed(self.path, self._points, trainer.options.seeding.order(ids, trainer.extent))
            self._used = ids
            return self._epochs(steps)
        trainer.restart()
        self._used = ids[:1]
        rotations, centres = self.path.poses([trainer.views[ids[0]].time])
        view = trainer.views.image(ids[0])
        trainer.mapper.seed_view(view, rotations[0], centres[0], _scaled(self._first_depth, view.rate.shape[:2]))
        trainer.planner.depth = trainer.mapper.depth = FLAT_DEPTH
        trainer.fit_with(LossName.INTERVAL)
        self._use(self._used)
        if steps == 0:
            return []
        growth = self._growth(len(ids) - 1, int(self._options.growth_share * steps))
        return [*growth, (_Kind.WHOLE, 0), *self._epochs(max(steps - _steps_of(growth), 0))]

    def _growth(self, views: int, steps: int) -> list[_Action]:
        """Add this many views within `steps`, each with `LEAST_STEPS` at least."""
        o = self._options
        first = min(o.first_steps, steps // 4)
        each = max(LEAST_STEPS, (steps - first) // max(views, 1))
        pose = max(1, each * o.pose_steps // (o.pose_steps + o.scene_steps))
        one: list[_Action] = [(_Kind.ADD, 0), (_Kind.POSE, pose), *[(_Kind.SCENE, 1)] * (each - pose)]
        return [*[(_Kind.SCENE, 1)] * first, *one * views]

    def _epochs(self, steps: int) -> list[_Action]:
        """Epochs of pose steps and scene steps."""
        o = self._options
        posing = o.pose_steps if self._pose_step is not None else 0
        length = posing + o.scene_steps
        epochs = max(o.least_epochs, round(steps / length))
        pose, scene = posing * steps // (length * epochs), o.scene_steps * steps // (length * epochs)
        chunks = [min(o.chunk, pose - begin) for begin in range(0, pose, o.chunk)]
        poses: list[_Action] = [(_Kind.SELECT, 0), *[(_Kind.POSE, count) for count in chunks]]
        scenes: list[_Action] = [(_Kind.SELECT, 0), *[(_Kind.SCENE, 1)] * scene]
        # A map that was only seeded would spoil a path that is known.
        return [*poses, *scenes] * epochs if self._progressive else [*scenes, *poses] * epochs

    def _act(self, kind: _Kind, count: int, share: float) -> None:
        trainer, schedule = self._trainer, self._trainer.options.schedule
        match kind:
            case _Kind.SCENE:
                trainer.step(self.path, schedule.rate(share), schedule.coarseness(share), share)
            case _Kind.POSE if self._pose_step is not None and isinstance(self.path, Spline):
                ids = self._used[-1:] if self._growing else self._keys
                self.path = self._pose_step.improve(self.path, ids, count, share)
            case _Kind.ADD:
                self._add()
            case _Kind.WHOLE:
                self._growing = False
                self._use(self._used)
            case _Kind.SELECT:
                self._select()
        self._progress.done += count

    def _use(self, ids: list[int]) -> None:
        self._keys = ids
        self._trainer.use_only(ids)

    def _add(self) -> None:
        """Add the next view, where constant velocity takes the camera."""
        trainer = self._trainer
        ids = trainer.views.mappable(self.path)
        at = ids.index(self._used[-1]) + 1
        assert isinstance(self.path, Spline)
        self.path = continued(self.path, trainer.views[ids[at - 1]].time)
        self._used = ids[: at + 1]
        if trainer.loss is not trainer.options.loss:
            trainer.fit_with(trainer.options.loss)
        # Every second time all views, so that the old ones are not forgotten.
        self._use(self._used if at % 2 else self._used[-self._options.recent_views :])

    def _select(self) -> None:
        """Choose the views whose loss exceeds the mean."""
        if not self._options.key_frames:
            self._use(self._used)
            return
        trainer = self._trainer
        losses = np.array([trainer.compare(self.path, i).value for i in self._used])
        self._use([i for i, loss in zip(self._used, losses, strict=True) if loss >= losses.mean()])


def _steps_of(plan: list[_Action]) -> int:
    return sum(count for kind, count in plan if kind in (_Kind.SCENE, _Kind.POSE))


def _scaled(depth: Array | None, shape: tuple[int, ...]) -> Image:
    """A depth [H, W] with `FLAT_DEPTH` as its median and where nothing is known; flat without one."""
    if depth is None:
        return np.full(shape, FLAT_DEPTH, np.float32)
    if depth.shape != shape:
        raise ConfigurationError(f"the depth of the first view is {depth.shape}, expected {shape} as its views")
    known = np.isfinite(depth) & (depth > 0)
    return np.where(known, depth * FLAT_DEPTH / np.median(depth[known]), FLAT_DEPTH).astype(np.float32)


def through_views(path: Spline, times: Sequence[float]) -> Spline:
    """The path as a linear spline with a knot for each view at `times` (frames): knots that no view sees would follow
    noise."""
    spacing = max(float(np.median(np.diff(times))), LEAST_KNOT_FRAMES)
    frames = np.arange(np.ceil(path.begin), path.end)
    span = times[0] - spacing, times[-1] + spacing
    return Spline.fit(frames, *path.poses(frames), spacing, 1, span)


def continued(path: Spline, time: float) -> Spline:
    """The path with constant velocity from `time` (frames) on: each later knot is one step further."""
    first, weights = path.locate([time])
    last = int(first[0]) + int(weights[0, 1] > 0.5 - 1e-6)
    if last + 1 >= len(path.centres):
        return path
    rotations, centres = path.rotations.copy(), path.centres.copy()
    turn = log_so3(rotations[last] @ rotations[last - 1].T)
    way = centres[last] - centres[last - 1]
    ahead = np.arange(1, len(centres) - last)[:, None]
    rotations[last + 1 :] = exp_so3(ahead * turn) @ rotations[last]
    centres[last + 1 :] = centres[last] + ahead * way
    return replace(path, rotations=rotations, centres=centres)
