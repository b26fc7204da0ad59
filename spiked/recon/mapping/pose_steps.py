"""What corrects a path by the map: a Gauss-Newton step of all knots, or steps along the rasteriser's pose gradient."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from spiked.pose import Array
from spiked.recon.mapping.pose_alignment import TrajectoryPrior, align_spline
from spiked.recon.mapping.trainer import MapTrainer, ViewRender
from spiked.sensor import Image
from spiked.spline import Spline

ALIGNED_VIEWS = 160
"""Most views of an alignment."""
APART_FRAMES = 32.0
"""Frames between the two renders whose difference is compared, n of the paper (Eq 6)."""
STEP_PX = 0.1, 0.005
"""Image motion of one step of Adam at the begin and at the end of the refinement: the first reaches 0.5 px in the steps
that a view gets, the last is below the error to be corrected (docs/paper.md)."""
MOMENTS = 0.9, 0.99
"""Adam's decay rates, in steps of a knot."""


class PoseStep(Protocol):
    """Corrects a path."""

    def improve(self, path: Spline, ids: Sequence[int], steps: int, share: float) -> Spline:
        """The path after about `steps` steps on the views `ids`; `share` of the refinement is done."""


@dataclass
class GaussNewton:
    """One damped step of `align_spline` over all views, whatever the number of steps."""

    trainer: MapTrainer
    prior: TrajectoryPrior | None = None
    taken: int = 0
    """Number of steps so far: each is shorter than the one before, see `Schedule.alignment_step`."""

    def improve(self, path: Spline, ids: Sequence[int], steps: int, share: float) -> Spline:
        """See `PoseStep.improve`."""
        del steps, share
        self.taken += 1
        ids, trainer = ids[:: -(-len(ids) // ALIGNED_VIEWS)], self.trainer
        times, part = [trainer.views[i].time for i in ids], trainer.options.schedule.alignment_step(self.taken)
        return align_spline(path, times, trainer.views.images(ids), trainer.mapper, trainer.planner, self.prior, part)


class PoseGradient:
    """Adam on the knots of a path, along the exact gradient by the poses of the sub-frames (Eq 6 to 12).

    A pose is perturbed on the left, R <- Exp(phi) R and c <- c + d (Eq 12 has the same for the inverse pose). The
    gradient by the pose of a sub-frame reaches the knots with their basis weights, which is exact for knots that turn
    together, and off by the angle between two knots otherwise. The first knot stays.
    """

    def __init__(self, trainer: MapTrainer, seed: int, difference: bool = True, step_px: tuple[float, float] = STEP_PX):
        """With `difference` two renders `APART_FRAMES` apart are compared by their difference (Eq 6 to 8), otherwise
        each with its own target, by the loss of the map."""
        self._trainer = trainer
        self._difference = difference
        self._step_px = step_px
        self._rng = np.random.default_rng(seed)
        self._moments = np.zeros((2, 0, 6))
        self._taken = np.zeros(0)

    def improve(self, path: Spline, ids: Sequence[int], steps: int, share: float) -> Spline:
        """See `PoseStep.improve`; each step is on one view of a random order."""
        order: list[int] = []
        for _ in range(steps):
            order = order or [int(i) for i in self._rng.permutation(ids)]
            _, gradient = self.gradient(path, order.pop())
            path = self._descend(path, gradient, share)
        return path

    def gradient(self, path: Spline, view_id: int) -> tuple[float, Array]:
        """The loss of a view and its gradient by the knots, [knots, 6]: rotation vector on the left, centre."""
        trainer, knots = self._trainer, np.zeros((len(path.centres), 6))
        level, white = trainer.mapper.alignment_level, trainer.mapper.white
        other = self._apart(path, view_id) if self._difference else None
        here = trainer.render(path, view_id, level)
        if other is None:
            made = trainer.mapper.view_loss.compare(here.expected, here.target, white, level.mosaic)
            _add_by_knots(here, made.slope, path, knots)
            return made.value, knots
        there = trainer.render(path, other, level)
        seen = np.isfinite(here.target.deviation) & np.isfinite(there.target.deviation)
        error = np.where(seen, (here.expected - there.expected) - (here.target.values - there.target.values), 0)
        slope = np.asarray(2 * error / (white**2 * error.size), np.float32)
        _add_by_knots(there, -slope, path, knots)
        _add_by_knots(trainer.render(path, view_id, level), slope, path, knots)
        return float(np.mean(error**2)) / white**2, knots

    def _apart(self, path: Spline, view_id: int) -> int | None:
        """The view about `APART_FRAMES` before this one, or after it at the begin; None without any."""
        views = self._trainer.views
        time, ids = views[view_id].time, [i for i in self._trainer.usable(path) if i != view_id]
        before = [i for i in ids if views[i].time < time - APART_FRAMES / 2] or ids
        return min(before, key=lambda i: abs(abs(views[i].time - time) - APART_FRAMES), default=None)

    def _descend(self, path: Spline, gradient: Array, share: float) -> Spline:
        if len(self._taken) != len(gradient):
            self._moments, self._taken = np.zeros((2, *gradient.shape)), np.zeros(len(gradient))
        gradient[0] = 0
        moved = np.abs(gradient).max(1) > 0
        self._taken[moved] += 1
        first, second = MOMENTS
        self._moments[0][moved] = first * self._moments[0][moved] + (1 - first) * gradient[moved]
        self._moments[1][moved] = second * self._moments[1][moved] + (1 - second) * gradient[moved] ** 2
        taken = np.maximum(self._taken, 1)[:, None]
        mean, square = self._moments[0] / (1 - first**taken), self._moments[1] / (1 - second**taken)
        begin_px, end_px = self._step_px
        angle = begin_px * (end_px / begin_px) ** share / self._trainer.camera.intrinsics.fx
        rates = angle * np.repeat([1.0, self._trainer.planner.depth], 3)
        step = np.where(moved[:, None], -rates * mean / (np.sqrt(square) + 1e-30), 0)
        return path.move(step[:, :3], step[:, 3:])


def _add_by_knots(made: ViewRender, slope: Image, path: Spline, knots: Array) -> None:
    """Add the gradient by the knots, [knots, 6], for one by the image that was rendered last."""
    gradients = made.level.rasteriser.backward(slope if made.factor is None else slope * made.factor)
    first, weights = path.locate(np.clip(made.request.times, path.begin, path.end))
    poses = np.concatenate([gradients.rotation, gradients.centre], 1)
    at = first[:, None] + np.arange(weights.shape[1])
    np.add.at(knots, at, weights[..., None] * poses[:, None])
