"""Adjustment of long paths: bundle adjustment of keyframes, in a window while tracking, and of all of them after loops
and at the end.

The cost of an adjustment in the window is bounded. Those of all keyframes grow with their number: while tracking they
run on another thread. The path is interpolated between the views, see `SparseMap.waypoints`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from spiked.pose import Array
from spiked.recon.background import Background
from spiked.recon.frontend.feature_tracks import Picture
from spiked.recon.odometry import banded_bundle
from spiked.recon.odometry.initialisation import SCALE_PX
from spiked.recon.odometry.loop_closure import LoopClosure, LoopSearch, find_closures, spread_drift
from spiked.recon.odometry.path_adjuster import PathAdjuster
from spiked.recon.odometry.pnp import fit_pose
from spiked.recon.odometry.self_calibration import estimates, find_distortion
from spiked.recon.odometry.sparse_map import MapBundle, Pose, SparseMap, TrackedView
from spiked.recon.statistics import evenly
from spiked.sensor import LEAST_DEPTH
from spiked.spline import Spline

KEYFRAME_PX = 4.0
"""Image motion from one keyframe to the next: 10 px triple the error, 2 px do not lower it (decision 15)."""
LEAST_MOTION_PX, MOST_MOTION_PX = 2.0, 24.0
"""Image motion between views whose images are kept, at least and at most."""
WINDOW_KEYFRAMES, FIXED_KEYFRAMES = 60, 10
"""Newest keyframes that are adjusted while tracking, and those before them that fix the gauge (decision 15)."""
WINDOW_PX, LEAST_WINDOW = 480.0, 16
"""Image motion that the free ones of these span at most, but for so many: of a live camera's views, which lie far
apart, fewer suffice, and the tracker must not stop for long."""
ADJUST_EVERY = 8
"""New keyframes from one adjustment to the next (decision 15)."""
REFERENCE_KEYFRAMES = 60
"""Newest keyframes from which tracks are triangulated, and to which the newest views are adjusted (decision 15)."""
REFITTED_VIEWS = 48
"""Newest views that are fitted again after an adjustment but the last; those before move with their keyframe."""
LOOP_ROUNDS = 4
"""Searches for loops at the end, at most: each closes the first loop of the path that is open (decision 15)."""
SPREAD_PX = 2.0
"""Correction by a closure, as image motion, from which on it is spread over the loop; smaller ones are left to the
adjustments."""
WHOLE_KEYFRAMES = 1000
"""Keyframes that are adjusted together, at most: time grows with the cube of their number where a path goes through the
same places again and again. Of more, these are spread evenly (decision 15)."""
LIVE_WHOLE_KEYFRAMES = 250
"""The same while a live camera is tracked, as the tracker shares the cores with the adjustment."""
PRELIMINARY_KEYFRAMES = 350
"""The same for a preliminary path, which somebody waits for: 0.57 to 0.59 % after 28 s instead of 0.63 to 0.75 % after
19 s, a minute's walk (decision 64)."""
WHOLE_GROWTH = 1.5
"""Growth of the number of keyframes from one adjustment of all of them while tracking to the next: their cost over a
recording stays in proportion to its length."""
TAKEN_AFTER = 8
"""New keyframes, as a share of one over this number of all, after which the result is taken: it must not depend on the
time that an adjustment takes, and tracking should not have to wait."""
FINAL_SCALE_PX = 0.1
"""Scale of the Cauchy loss in the adjustment of all keyframes: tracks across a whole image are off by up to 0.3 px
where their surroundings lie at several depths (decision 15)."""
WINDOW_ITERATIONS, LOOP_ITERATIONS, FINAL_ITERATIONS = 4, 4, 12
"""Most iterations of an adjustment in the window, after a loop and at the end."""
LENS_KEYFRAMES, LENS_PX, LEAST_LENS_KEYFRAMES = 120, 960.0, 40
"""Newest keyframes in which a distortion is looked for that nobody stated: 480 px of image motion, and at most twice
that, but for so many."""
LENS_GROWTH = 1.5
"""Factor of the number of keyframes from one look to the next."""
MOST_LOG_SCALE = 0.3
"""Largest change of a point's depth, as a logarithm, that counts where the change of scale is measured."""
FINAL_ROUNDS = 3
"""Final adjustments, each with the points that the one before dropped or that the closed loops tell anew (decision
15)."""
LOOP_SHARE = 0.25
"""Share of the work of `finish` that its first search for loops is taken to be, with the adjustment after it."""
TOLERANCE = 1e-3
"""Relative gain of an iteration below which an adjustment ends."""


@dataclass
class KeyframeAdjuster(PathAdjuster):
    """Keyframes of a long path and their adjustment."""

    map: SparseMap
    pictures: Mapping[int, Picture]
    """Images by view id of the views among which loops are searched: the keyframes of the `Relocaliser`."""
    loops: LoopSearch
    keyframes: list[TrackedView] = field(default_factory=list)
    interpolated: bool = True
    """There is no spline: the path is interpolated between views."""
    spline: Spline | None = None
    """None: see `interpolated`."""
    closures: list[tuple[float, float]] = field(default_factory=list)
    """Closed loops: times in frames of an earlier view and of a later one that sees the same place again."""
    _travelled_px: float = 0.0
    """Image motion since the newest keyframe."""
    _next_view: int = 0
    """First view that has not been considered as a keyframe."""
    _adjusted: int = 0
    """Number of keyframes at the last adjustment."""
    _linked: dict[int, LoopClosure] = field(default_factory=dict)
    """Closures by id of the later view."""
    live: bool = False
    """Results of other threads are taken once they are there: a camera does not wait for them."""
    _lens_search: Background[MapBundle | None] | None = None
    """Search for a distortion that runs."""
    _whole: Background[MapBundle] | None = None
    """Adjustment of all keyframes that runs."""
    _whole_due: float = 0.0
    """Number of keyframes at which its result is taken; without one, from which the next may begin."""
    _looked: int = 0
    """Number of keyframes when a distortion was last looked for."""
    _open: bool = False
    """Loops were closed since the last adjustment of all keyframes."""
    _loop_rounds: int = 0
    _final_rounds: int = 0
    """Rounds of `finish` that are done."""

    @property
    def end_left(self) -> float:
        """See `PathAdjuster.end_left`."""
        loops = LOOP_SHARE if self._loop_rounds == 0 else 0.0
        return loops + (1 - LOOP_SHARE) * (1 - self._final_rounds / FINAL_ROUNDS)

    @property
    def reference_views(self) -> list[TrackedView]:
        """Keyframes that fix the newest views."""
        self._choose()
        return self.keyframes[-REFERENCE_KEYFRAMES:]

    @property
    def newest_keyframe(self) -> TrackedView | None:
        """The newest keyframe."""
        self._choose()
        return self.keyframes[-1] if self.keyframes else None

    @property
    def due(self) -> bool:
        """Whether enough keyframes were added since the last adjustment."""
        self._choose()
        return len(self.keyframes) >= self._adjusted + ADJUST_EVERY

    def adjust(self, final: bool = True) -> None:
        """Adjust the newest keyframes and their points; the views after them follow."""
        del final
        self._adjusted = len(self.keyframes)
        self._take_whole()
        free = self._newest(WINDOW_KEYFRAMES, WINDOW_PX, LEAST_WINDOW)
        recent = [view for view in self.keyframes[-free - FIXED_KEYFRAMES :] if view.pose is not None]
        if len(recent) <= FIXED_KEYFRAMES + 2:
            return
        first, first_free = recent[0].id, recent[FIXED_KEYFRAMES].id
        chosen = {view.id: view for view in recent}
        for closure in self._linked.values():
            if closure.later.id >= first:
                chosen |= {closure.earlier.id: closure.earlier, closure.later.id: closure.later}
        if (made := self.map.bundle(_in_order(chosen))) is None:
            return
        fixed = np.array([view.id < first_free for view in made.views])
        made.bundle.optimise(WINDOW_ITERATIONS, SCALE_PX, fixed, TOLERANCE)
        self._take(made, self.map.views[first:])
        self._look_for_distortion()
        self._adjust_whole_if_due()

    def _newest(self, most: int, most_px: float, least: int) -> int:
        """Number of newest keyframes, up to `most`; of a live camera those that span at most this image motion, or
        `least`."""
        if not self.live:
            return most
        travelled_px = [self.map.travelled_px(view.id) for view in self.keyframes[-most:]]
        return max(sum(px >= travelled_px[-1] - most_px for px in travelled_px), least)

    def _look_for_distortion(self, now: bool = False) -> None:
        """Look for a distortion in the newest keyframes if it is time to, on another thread.

        Of a live camera its answer is taken at a later adjustment, once it is there, unless it is to be `now`.
        """
        self._take_lens_search(now)
        count = len(self.keyframes)
        due = count > self._looked if now else count >= max(LENS_KEYFRAMES, LENS_GROWTH * self._looked)
        if not due or self._lens_search is not None or self.map.lens_known or self.map.lens is not None:
            return
        self._looked = count
        if (sample := self._newest_for_lens()) is not None:
            self._lens_search = Background(lambda stop: _distorted(sample), behind=self.live)
            self._take_lens_search(now)

    def _take_lens_search(self, now: bool) -> None:
        if self._lens_search is None or (self.live and not now and not self._lens_search.done):
            return
        found, self._lens_search = self._lens_search.result(), None
        if found is not None:
            self._take_distortion(found)

    def _newest_for_lens(self) -> MapBundle | None:
        """A bundle of the keyframes in which a distortion is looked for; None if they are too few."""
        newest = self._newest(LENS_KEYFRAMES, LENS_PX, LEAST_LENS_KEYFRAMES)
        recent = [view for view in self.keyframes[-newest:] if view.pose is not None]
        if len(recent) <= FIXED_KEYFRAMES or (made := self.map.bundle(recent)) is None:
            return None
        made.bundle.free = self.map.free_optics
        return made

    def _take_distortion(self, made: MapBundle) -> None:
        """Let the lens be estimated from now on that keyframes show, adjusted with it.

        They and the views after them follow at once, the path before them with the next adjustment of all keyframes.
        """
        if self._whole is not None and self.live:
            self._whole.stop()
            self._whole = None  # it knows of no lens
        elif self._whole is not None:
            self._take_whole(now=True)
            if (sample := self._newest_for_lens()) is None or (again := _distorted(sample)) is None:
                return
            made = again
        _, self.map.lens = estimates(made.bundle)
        self.map.take_optics(made.bundle)
        self._take(made, self.map.views[made.views[0].id :])
        self._open, self._whole_due = True, 0.0

    def close_loops(self, view: TrackedView) -> list[LoopClosure]:
        """Search the newest view, whose image is kept, for places seen before, and close the loops that are certain."""
        closures = self.loops.search(view)
        if not closures:
            return []
        drifted = max(closure.correction_px(self.map.intrinsics) for closure in closures) > SPREAD_PX
        if drifted and self.live and self._whole is not None and not self._whole.done:
            self.loops.forget()  # the views that follow find the loop again, when the path is adjusted
            return []
        self._link(closures)
        self._open = True
        if drifted:
            self._take_whole(now=True)
            spread_drift(self.map, closures)
            self.loops.closed()
        self.adjust()
        return closures

    def join(self, views: list[TrackedView], closures: list[LoopClosure]) -> None:
        """Go on after `views` got poses at once, by a second map that the closures join with this one."""
        self._take_whole(now=True)
        self.loops.add_kept(view for view in views if view.id in self.pictures)
        self._link(closures)
        self._open, self._whole_due = True, 0.0
        self.adjust()

    def settle(self) -> None:
        """Take what runs on another thread."""
        self._take_whole(now=True)

    def _link(self, closures: list[LoopClosure]) -> None:
        for closure in closures:
            closure.add_tracks()
            self._linked[closure.later.id] = closure
            self.closures.append((closure.earlier.time, closure.later.time))

    def _adjust_whole_if_due(self) -> None:
        """Begin to adjust all keyframes if loops were closed, and the path has grown enough since the last time."""
        if not self._open or self._whole is not None or len(self.keyframes) < self._whole_due:
            return
        most = LIVE_WHOLE_KEYFRAMES if self.live else WHOLE_KEYFRAMES
        if (made := self.map.bundle(self._all_chosen(most))) is None:
            return
        found = made  # for the function: not None
        first = np.arange(len(made.views)) < 1

        def work(stop: Callable[[], bool]) -> MapBundle:
            banded_bundle.optimise(found.bundle, LOOP_ITERATIONS, FINAL_SCALE_PX, first, TOLERANCE, stop)
            return found

        self._open, self._whole = False, Background(work, behind=self.live)
        self._whole_due = len(self.keyframes) * (1 + 1 / TAKEN_AFTER)

    def _take_whole(self, now: bool = False) -> None:
        """Take the result of the adjustment of all keyframes if it is due, or `now`."""
        if self._whole is None:
            return
        if not now and (not self._whole.done if self.live else len(self.keyframes) < self._whole_due):
            return
        cut_short = self.live and not self._whole.done
        if cut_short:
            self._whole.stop()
        made, self._whole = self._whole.result(), None
        self._open |= cut_short
        self._whole_due = 0.0 if cut_short else WHOLE_GROWTH * len(self.keyframes)
        self._take(made, self.map.views)

    def _all_chosen(self, most: int) -> list[TrackedView]:
        """All keyframes, or `most` of them spread evenly, and the views of closed loops."""
        posed = [view for view in self.keyframes if view.pose is not None]
        chosen = {posed[row].id: posed[row] for row in evenly(len(posed), most)}
        for closure in self._linked.values():
            chosen |= {closure.earlier.id: closure.earlier, closure.later.id: closure.later}
        return _in_order(chosen)

    def finish(
        self,
        stop: Callable[[], bool] = lambda: False,
        save: Callable[[], None] = lambda: None,
        preliminary: bool = False,
    ) -> None:
        """Close loops and adjust all keyframes; every view follows. See `PathAdjuster.finish` about the arguments."""
        most = PRELIMINARY_KEYFRAMES if preliminary else WHOLE_KEYFRAMES
        loop_iterations = FINAL_ITERATIONS if preliminary else LOOP_ITERATIONS  # fewer keyframes converge slowly
        self._choose()
        if self._whole is not None and stop():
            self._whole.stop()
        self._take_whole(now=True)
        if not stop():
            self._look_for_distortion(now=True)
        while self._loop_rounds < LOOP_ROUNDS and not stop():
            found = find_closures(self.map, self.pictures, self.loops.index)
            closures = spread_drift(self.map, found)
            if closures or (self._open and self._loop_rounds == 0):
                self._link(closures)
                self._adjust_all(loop_iterations, most, stop)
                self._loop_rounds += 1
            else:
                self._loop_rounds = LOOP_ROUNDS
            if not stop():  # otherwise the round is not done
                save()
        while self._final_rounds < FINAL_ROUNDS and not stop():
            self._final_rounds += 1
            self._adjust_all(FINAL_ITERATIONS, most, stop, refit_all=self._final_rounds == FINAL_ROUNDS)
            self.map.triangulate(self._all_chosen(most))
            if not stop():
                save()

    def _adjust_all(self, iterations: int, most: int, stop: Callable[[], bool], refit_all: bool = False) -> None:
        """Adjust all keyframes, or `most`, and their points; all other views follow, see `_take`."""
        keyframes = self._all_chosen(most)
        if len(keyframes) <= 2 or (made := self.map.bundle(keyframes)) is None:
            return
        made.bundle.free = self.map.free_optics
        first = np.arange(len(keyframes)) < 1
        banded_bundle.optimise(made.bundle, iterations, FINAL_SCALE_PX, first, TOLERANCE, stop)
        self.map.take_optics(made.bundle)
        self._take(made, self.map.views, refit_all)

    def _choose(self) -> None:
        """Make views keyframes that are far enough from the newest one."""
        for view in self.map.views[self._next_view :]:
            self._travelled_px += view.moved_px
            if view.pose is not None and (not self.keyframes or self._travelled_px >= KEYFRAME_PX):
                self.keyframes.append(view)
                self._travelled_px = 0.0
        self._next_view = len(self.map.views)

    def _take(self, made: MapBundle, followers: list[TrackedView], refit_all: bool = False) -> None:
        """Take over adjusted keyframes and points.

        `followers` and the other points in them move with the keyframe before them. The newest of these views are then
        fitted to the points, or all of them: that takes seconds for a path of 10 s.
        """
        refit_from = 0 if refit_all else len(self.map.views) - REFITTED_VIEWS
        motion = _Motion.of(made, self.map)
        self.map.noise_px = made.bundle.noise_px()
        self.map.apply(made)
        row_of = np.full(len(self.map.points), -1)
        for view in followers:
            row_of[view.ids] = motion.row(view.id)
        row_of[made.ids] = -1
        moved = np.flatnonzero((row_of >= 0) & np.isfinite(self.map.points[:, 0]))
        self.map.points[moved] = motion.points(row_of[moved], self.map.points[moved])
        adjusted = {view.id for view in made.views}
        for view in {view.id: view for view in [*made.views, *followers]}.values():
            view.scale *= motion.scale(view.id)
        for view in followers:
            if view.pose is None or view.id in adjusted:
                continue
            view.pose = motion.pose(motion.row(view.id), view.pose)
            if view.id >= refit_from:
                fit = fit_pose(self.map, view, view.pose)
                if fit.lost_reason() is None:
                    fit.store(view)


def _distorted(sample: MapBundle) -> MapBundle | None:
    """Keyframes adjusted with the distortion that they show; None if they show none."""
    sample.bundle.optimise(WINDOW_ITERATIONS, SCALE_PX, None, TOLERANCE)
    found = find_distortion(sample.bundle)
    return None if found is None else replace(sample, bundle=found)


@dataclass(frozen=True)
class _Motion:
    """How the neighbourhood of each of C keyframes moves in an adjustment."""

    ids: NDArray[np.int64]
    """[C] of the keyframes, ascending."""
    turns: Array
    """[C, 3, 3]"""
    scales: Array
    """[C]"""
    before: Array
    """[C, 3] centres."""
    after: Array
    """[C, 3] centres."""

    @classmethod
    def of(cls, made: MapBundle, sparse_map: SparseMap) -> "_Motion":
        """From a map to what a bundle of it has become."""
        b = made.bundle
        rotations, before = (np.stack(part) for part in zip(*(v.pose for v in made.views if v.pose), strict=True))
        depths = [
            np.einsum("mi,mi->m", (points[b.point] - centres[b.camera]), turns[b.camera][:, :, 2])
            for points, centres, turns in (
                (sparse_map.points[made.ids], before, rotations),
                (b.points, b.centres, b.rotations),
            )
        ]
        good = (depths[0] > LEAST_DEPTH) & (depths[1] > LEAST_DEPTH)
        ratio = np.log(depths[1][good] / depths[0][good]).clip(-MOST_LOG_SCALE, MOST_LOG_SCALE)
        count = len(before)
        seen = np.maximum(np.bincount(b.camera[good], minlength=count), 1)
        scales = np.exp(np.bincount(b.camera[good], ratio, count) / seen)
        ids = np.array([view.id for view in made.views])
        return cls(ids, b.rotations @ rotations.swapaxes(1, 2), scales, before, b.centres)

    def row(self, number: int) -> int:
        """The keyframe that a view moves with: the one before it."""
        return max(int(np.searchsorted(self.ids, number, side="right")) - 1, 0)

    def scale(self, number: int) -> float:
        """Growth of the lengths around a view."""
        return float(self.scales[self.row(number)])

    def points(self, rows: NDArray[np.int64], points: Array) -> Array:
        """Points [n, 3] moved with their keyframes [n]."""
        turned = np.einsum("nij,nj->ni", self.turns[rows], points - self.before[rows])
        return np.asarray(self.after[rows] + self.scales[rows, None] * turned)

    def pose(self, row: int, pose: Pose) -> Pose:
        """A pose moved with a keyframe."""
        turn = self.turns[row]
        return Pose(turn @ pose.rotation, self.after[row] + self.scales[row] * turn @ (pose.centre - self.before[row]))


def _in_order(views: dict[int, TrackedView]) -> list[TrackedView]:
    """Views with a pose, in order of their ids."""
    return [views[number] for number in sorted(views) if views[number].pose is not None]
