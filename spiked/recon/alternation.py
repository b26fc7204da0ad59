"""The schedule of Nope-SGS: poses and scene in turn, on key frames, with views that are added one by one."""

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from enum import Enum, auto

import numpy as np

from spiked.pose import Array, exp_so3, log_so3
from spiked.recon.mapping.loss import LossName
from spiked.recon.mapping.pose_steps import PoseStep
from spiked.recon.mapping.trainer import MapTrainer
from spiked.recon.methods import Alternation
from spiked.spline import Path, Spline

PROGRESS_STEPS = 50
"""Steps between reports of progress."""
LEAST_STEPS = 3
"""Steps for each view that is added, one of them of its pose."""
FLAT_DEPTH = 1.0
"""Depth of the first splats, where the path grows with the map: it is the unit of length."""


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
    ) -> None:
        """points [N, 3] are landmarks on `path`. Without a `pose_step` the path is not changed; `progressive`: nothing
        is known of the path, a linear spline, and views are added one by one."""
        self.path = path
        """The path so far."""
        self._trainer = trainer
        self._points = points
        self._pose_step = pose_step
        self._options = options
        self._progressive = progressive
        self._used: list[int] = []
        self._keys: list[int] = []
        self._growing = progressive
        self._plan: list[_Action] | None = None
        self._next = 0
        """Number of the action that comes next."""
        self._done = 0
        """Steps taken."""
        self._spent_s = 0.0

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
        plan, begin = self._plan, time.perf_counter() - self._spent_s
        total = max(1, sum(count for kind, count in plan if kind in (_Kind.SCENE, _Kind.POSE)))
        available_s, reported = max(deadline - begin, 1e-9), self._done
        while self._next < len(plan):
            self._spent_s = time.perf_counter() - begin
            share = max(self._done / total, self._spent_s / available_s)
            save()
            if share >= 1 or cancelled():
                break
            self._act(*plan[self._next], share)
            self._next += 1
            if self._done - reported >= PROGRESS_STEPS:
                reported = self._done
                yield max(share, self._done / total)
        self._trainer.use_only(None)

    def _begin(self, most_steps: int) -> list[_Action]:
        """Make the first splats; returns what is to be done."""
        trainer, ids = self._trainer, self._trainer.views.mappable(self.path)
        fast = float(np.mean([trainer.views[i].frames.warped is not None for i in ids]))
        pixels = trainer.camera.width * trainer.camera.height
        steps = trainer.options.schedule.steps(most_steps, pixels, fast, trainer.extent)
        if not self._progressive:
            if trainer.stale(self.path):
                trainer.restart()
            trainer.seed(self.path, self._points, trainer.options.seeding.order(ids, trainer.extent))
            self._used = ids
            return self._epochs(steps)
        trainer.restart()
        self._used = ids[:1]
        rotations, centres = self.path.poses([trainer.views[ids[0]].time])
        trainer.mapper.seed_flat(trainer.views.image(ids[0]), rotations[0], centres[0], FLAT_DEPTH)
        trainer.planner.depth = trainer.mapper.depth = FLAT_DEPTH
        trainer.fit_with(LossName.INTERVAL)
        self._use(self._used)
        if steps == 0:
            return []
        growth = int(self._options.growth_share * steps)
        return [*self._growth(len(ids) - 1, growth), (_Kind.WHOLE, 0), *self._epochs(steps - growth)]

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
        epoch: list[_Action] = [(_Kind.SELECT, 0), *[(_Kind.POSE, count) for count in chunks]]
        return [*epoch, (_Kind.SELECT, 0), *[(_Kind.SCENE, 1)] * scene] * epochs

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
        self._done += count

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


def continued(path: Spline, time: float) -> Spline:
    """The path with constant velocity from `time` (frames) on: each later knot is one step further."""
    first, _ = path.locate([time])
    last = int(first[0]) + path.degree
    if last + 1 >= len(path.centres):
        return path
    rotations, centres = path.rotations.copy(), path.centres.copy()
    turn = log_so3(rotations[last] @ rotations[last - 1].T)
    way = centres[last] - centres[last - 1]
    ahead = np.arange(1, len(centres) - last)[:, None]
    rotations[last + 1 :] = exp_so3(ahead * turn) @ rotations[last]
    centres[last + 1 :] = centres[last] + ahead * way
    return replace(path, rotations=rotations, centres=centres)
