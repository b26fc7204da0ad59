"""What corrects a path by the map: a Gauss-Newton step of all knots, or steps along the rasteriser's pose gradient."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from spiked.pose import Array
from spiked.recon.mapping.pose_alignment import TrajectoryPrior, align, pose_curvature
from spiked.recon.mapping.trainer import MapTrainer, ViewRender
from spiked.sensor import Image
from spiked.spline import Path, Spline, Waypoints

ALIGNED_VIEWS = 160
"""Most views of an alignment of a spline."""
LONG_ALIGNED_VIEWS = 800
"""The same of a path that is interpolated between views: the matrix takes 184 MB then, and grows with the square. 400
are nearly as good (decision 58)."""
APART_FRAMES = 32.0
"""Frames between the two renders whose difference is compared, n of the paper (Eq 6)."""
STEP_SHARES = 0.3, 0.05
"""Share of the step to the minimum of the quadratic model of a view, at the begin and at the end of the refinement.
With 1 and 0.1 a path diverges at first, and ends worse (decision 41)."""
AVERAGED = 0.8
"""Decay rate of the running means of gradient and curvature, in steps of a knot; 0.9 is too slow (decision 41)."""
LONGEST_STEP = 0.02
"""Largest turn, rad, and way, in units of the map, of a knot in one step. Steps near the minimum are a hundredth of it;
a path that diverges would take ever longer ones, until it is not finite."""
CURVATURE_DAMPING = 1e-3
"""Added to the diagonal of the curvature, relative to it."""


class PoseStep(Protocol):
    """Corrects a path."""

    def improve(self, path: Path, ids: Sequence[int], steps: int, share: float) -> Path:
        """The path after about `steps` steps on the views `ids`; `share` of the refinement is done."""


@dataclass
class GaussNewton:
    """One step of `align` over all views, whatever the number of steps."""

    trainer: MapTrainer
    prior: TrajectoryPrior | None = None
    """On the knots of a spline."""
    taken: int = 0
    """Number of steps so far: each of a spline is shorter than the one before, see `Schedule.alignment_step`."""
    _tracked: Waypoints | None = None
    """The tracked path where it is interpolated between views."""

    def improve(self, path: Path, ids: Sequence[int], steps: int, share: float) -> Path:
        """See `PoseStep.improve`."""
        del steps, share
        self.taken += 1
        trainer = self.trainer
        mapper, planner = trainer.mapper, trainer.planner
        if isinstance(path, Spline):
            ids = ids[:: -(-len(ids) // ALIGNED_VIEWS)]
            times, part = [trainer.views[i].time for i in ids], trainer.options.schedule.alignment_step(self.taken)
            return align(path, times, trainer.views.images(ids), mapper, planner, self.prior, part)
        assert isinstance(path, Waypoints)
        ids = trainer.views.spread(ids, LONG_ALIGNED_VIEWS)
        self._tracked = tracked = self._tracked or path
        times, moved_px = [trainer.views[i].time for i in ids], np.diff(trainer.views.travelled_to(ids))
        rad = 1 / trainer.camera.intrinsics.fx
        known = TrajectoryPrior.drifting(*tracked.poses(times), moved_px, rad, planner.depth)
        return align(path, times, trainer.views.images(ids), mapper, planner, known)


class PoseGradient:
    """Descends on the knots of a path along the exact gradient by the poses of the sub-frames (Eq 6 to 12).

    A pose is perturbed on the left, R <- Exp(phi) R and c <- c + d (Eq 12 has the same for the inverse pose). The
    gradient by the pose of a sub-frame reaches the knots with their basis weights, which is exact for knots that turn
    together, and off by the angle between two knots otherwise.

    The gradient is divided by the curvature [6, 6] of each knot, a running mean over its views: a translation hardly
    differs from a rotation in the image, and steps of the same image motion in all six directions correct each by the
    other (docs/decisions/0041-curvature-of-the-pose-gradient.md). The knot of the first view stays.
    """

    def __init__(self, trainer: MapTrainer, seed: int, difference: bool = False):
        """The loss is the mean squared error of each view; with `difference`, that of the difference of two views
        `APART_FRAMES` apart (Eq 6 to 8)."""
        self._trainer = trainer
        self._difference = difference
        self._rng = np.random.default_rng(seed)
        self._slope = np.zeros((0, 6))
        self._curvature = np.zeros((0, 6, 6))

    def improve(self, path: Path, ids: Sequence[int], steps: int, share: float) -> Path:
        """See `PoseStep.improve`; each step is on one view of a random order. A path that is no spline stays."""
        if not isinstance(path, Spline):
            return path
        order: list[int] = []
        for _ in range(steps):
            order = order or [int(i) for i in self._rng.permutation(ids)]
            path = self._descend(path, self.model(path, order.pop()), share)
        return path

    def model(self, path: Spline, view_id: int) -> "PoseModel":
        """The loss of a view around a path."""
        trainer, made = self._trainer, PoseModel.of(path)
        level, white = trainer.mapper.alignment_level, trainer.mapper.white
        other = self._apart(path, view_id) if self._difference else None
        here = trainer.render(path, view_id, level)
        error, seen = here.expected - here.target.values, np.isfinite(here.target.deviation)
        if other is not None:
            there = trainer.render(path, other, level)
            error = error - (there.expected - there.target.values)
            seen &= np.isfinite(there.target.deviation)
        error = np.where(seen, error, np.float32(0))
        slope = np.asarray(2 * error / (white**2 * error.size), np.float32)
        made.loss = float(np.mean(error**2)) / white**2
        if other is not None:
            made.add(there, -slope, trainer, path, trainer.views[other].time, 2)
            here = trainer.render(path, view_id, level)
        made.add(here, slope, trainer, path, trainer.views[view_id].time, 1 if other is None else 2)
        return made

    def _apart(self, path: Spline, view_id: int) -> int | None:
        """The view about `APART_FRAMES` before this one, or after it at the begin; None without any."""
        views = self._trainer.views
        time, ids = views[view_id].time, [i for i in self._trainer.usable(path) if i != view_id]
        before = [i for i in ids if views[i].time < time - APART_FRAMES / 2] or ids
        return min(before, key=lambda i: abs(abs(views[i].time - time) - APART_FRAMES), default=None)

    def _descend(self, path: Spline, model: "PoseModel", share: float) -> Spline:
        knots = len(path.centres)
        if len(self._slope) != knots:
            self._slope, self._curvature = np.zeros((knots, 6)), np.zeros((knots, 6, 6))
        moved = np.abs(model.slope).max(1) > 0
        moved[first_view_knot(self._trainer, path)] = False
        for mean, new in ((self._slope, model.slope), (self._curvature, model.curvature)):
            mean[moved] = AVERAGED * mean[moved] + (1 - AVERAGED) * new[moved]
        begin, end = STEP_SHARES
        step = np.zeros((knots, 6))
        curved = self._curvature[moved]
        damping = CURVATURE_DAMPING * np.einsum("kii->ki", curved) + 1e-9 * np.trace(curved, axis1=1, axis2=2)[:, None]
        curved = curved + (damping + np.finfo(float).tiny)[:, :, None] * np.eye(6)
        step[moved] = -begin * (end / begin) ** share * np.linalg.solve(curved, self._slope[moved, :, None])[..., 0]
        step = np.clip(np.nan_to_num(step), -1, 1)
        turn, way = (part * _shortened(part) for part in (step[:, :3], step[:, 3:]))
        return path.move(turn, way)


def _shortened(step: Array) -> Array:
    """Factors [n, 1] by which steps [n, 3] are no longer than `LONGEST_STEP`."""
    length = np.linalg.norm(step, axis=1, keepdims=True)
    return np.asarray(LONGEST_STEP / np.maximum(length, LONGEST_STEP))


def first_view_knot(trainer: MapTrainer, path: Spline) -> int:
    """The knot nearest to the first view on the path: what stays, as the frame of a map is that of its first view."""
    first, weights = path.locate([trainer.views[trainer.views.mappable(path)[0]].time])
    return int(first[0] + np.argmax(weights[0]))


@dataclass
class PoseModel:
    """A quadratic model of the loss of a view by the knots of a path: rotation vector on the left, then centre."""

    slope: Array
    """Gradient [knots, 6]."""
    curvature: Array
    """[knots, 6, 6], Gauss-Newton; what couples two knots is added to both."""
    loss: float = 0.0

    @classmethod
    def of(cls, path: Spline) -> "PoseModel":
        """Without a view."""
        knots = len(path.centres)
        return cls(np.zeros((knots, 6)), np.zeros((knots, 6, 6)))

    def add(self, made: ViewRender, slope: Image, trainer: MapTrainer, path: Spline, time: float, factor: int) -> None:
        """Add the view at `time` that was rendered last, for a `slope` by its image; `factor` multiplies its
        curvature."""
        gradients = made.level.rasteriser.backward(slope if made.factor is None else slope * made.factor)
        first, weights = path.locate(np.clip(made.request.times, path.begin, path.end))
        poses = np.concatenate([gradients.rotation, gradients.centre], 1)
        at = first[:, None] + np.arange(weights.shape[1])
        np.add.at(self.slope, at, weights[..., None] * poses[:, None])
        shares = np.zeros(len(self.slope))
        np.add.at(shares, at, weights / len(weights))
        rotations, centres = path.poses([time])
        curved = pose_curvature(made.image, made.level, trainer.mapper.white, rotations[0], centres[0])
        self.curvature += factor * shares[:, None, None] * curved
