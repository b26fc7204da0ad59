"""Adjustment of long paths: bundle adjustment of keyframes, in a window while tracking and of all of them at the end.

The cost of one adjustment while tracking is bounded; the last one grows with the number of keyframes. The path is
interpolated between the views, see `SparseMap.waypoints`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from spiked.pose import Array
from spiked.recon.frontend.feature_tracks import Picture
from spiked.recon.odometry import banded_bundle
from spiked.recon.odometry.initialisation import SCALE_PX
from spiked.recon.odometry.loop_closure import find_closures, spread_drift
from spiked.recon.odometry.pnp import fit_pose
from spiked.recon.odometry.sparse_map import MapBundle, Pose, SparseMap, TrackedView
from spiked.spline import Spline

LONG_FRAMES, LONG_VIEWS = 12_000, 1000
"""Frames or views with a pose from which on a path is long: shorter ones are adjusted as a whole, on a spline (decision
15)."""
KEYFRAME_PX = 4.0
"""Image motion from one keyframe to the next: 10 px triple the error, 2 px do not lower it (decision 15)."""
LEAST_MOTION_PX = 2.0
"""Image motion between views whose images are kept, at least."""
WINDOW_KEYFRAMES, FIXED_KEYFRAMES = 60, 10
"""Newest keyframes that are adjusted while tracking, and those before them that fix the gauge (decision 15)."""
ADJUST_EVERY = 8
"""New keyframes from one adjustment to the next (decision 15)."""
REFERENCE_KEYFRAMES = 60
"""Newest keyframes from which tracks are triangulated, and to which the newest views are adjusted (decision 15)."""
REFITTED_VIEWS = 48
"""Newest views that are fitted again after an adjustment while tracking; those before move with their keyframe."""
LOOP_ROUNDS = 4
"""Searches for loops, at most: each closes the first loop of the path that is open (decision 15)."""
FINAL_SCALE_PX = 0.1
"""Scale of the Cauchy loss in the adjustment of all keyframes: tracks across a whole image are off by up to 0.3 px
where their surroundings lie at several depths (decision 15)."""
WINDOW_ITERATIONS, LOOP_ITERATIONS, FINAL_ITERATIONS = 4, 4, 12
"""Most iterations of an adjustment in the window, after a loop and at the end."""
TOLERANCE = 1e-3
"""Relative gain of an iteration below which an adjustment ends."""


@dataclass
class KeyframeAdjuster:
    """Keyframes of a long path and their adjustment; a `PathAdjuster`."""

    map: SparseMap
    pictures: Mapping[int, Picture]
    """Images by view id of the views among which loops are searched: the keyframes of the `Relocaliser`."""
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
        keyframes = [view for view in self.keyframes[-WINDOW_KEYFRAMES - FIXED_KEYFRAMES :] if view.pose is not None]
        if len(keyframes) <= FIXED_KEYFRAMES + 2 or (made := self.map.bundle(keyframes)) is None:
            return
        fixed = np.arange(len(keyframes)) < FIXED_KEYFRAMES
        made.bundle.optimise(WINDOW_ITERATIONS, SCALE_PX, fixed, TOLERANCE)
        self._take(made, self.map.views[keyframes[0].id :], len(self.map.views) - REFITTED_VIEWS)

    def finish(self, stop: Callable[[], bool] = lambda: False) -> None:
        """Close loops and adjust all keyframes; every view follows. See `PathAdjuster.finish` about `stop`."""
        self._choose()
        chosen = {view.id: view for view in self.keyframes if view.pose is not None}
        for _ in range(LOOP_ROUNDS):
            if stop():
                return
            closures = spread_drift(self.map, find_closures(self.map, self.pictures))
            if not closures:
                break
            for closure in closures:
                closure.add_tracks()
                chosen |= {closure.earlier.id: closure.earlier, closure.later.id: closure.later}
            self.closures += [(closure.earlier.time, closure.later.time) for closure in closures]
            self._adjust_all(chosen, LOOP_ITERATIONS, stop)
        self._adjust_all(chosen, FINAL_ITERATIONS, stop)
        self.map.triangulate(self.keyframes)

    def _adjust_all(self, chosen: dict[int, TrackedView], iterations: int, stop: Callable[[], bool]) -> None:
        """Adjust these views, by id, and their points; all others follow."""
        keyframes = [chosen[number] for number in sorted(chosen)]
        if len(keyframes) <= 2 or (made := self.map.bundle(keyframes)) is None:
            return
        made.bundle.focal_free = self.map.focal is not None
        first = np.arange(len(keyframes)) < 1
        banded_bundle.optimise(made.bundle, iterations, FINAL_SCALE_PX, first, TOLERANCE, stop)
        if self.map.focal is not None:
            self.map.intrinsics = made.bundle.intrinsics
            self.map.focal = replace(self.map.focal, intrinsics=made.bundle.intrinsics)
        self._take(made, self.map.views)

    def path_error(self) -> float | None:
        """Not predicted for long paths."""
        return None

    def information(self) -> Array | None:
        """None: there is no spline."""
        return None

    def _choose(self) -> None:
        """Make views keyframes that are far enough from the newest one."""
        for view in self.map.views[self._next_view :]:
            self._travelled_px += view.moved_px
            if view.pose is not None and (not self.keyframes or self._travelled_px >= KEYFRAME_PX):
                self.keyframes.append(view)
                self._travelled_px = 0.0
        self._next_view = len(self.map.views)

    def _take(self, made: MapBundle, followers: list[TrackedView], refit_from: int = 0) -> None:
        """Take over adjusted keyframes and points; `followers` move with them, see `_follow`."""
        before = [view.pose for view in made.views]
        self.map.noise_px = made.bundle.noise_px()
        self.map.apply(made)
        self._follow(made, before, followers, refit_from)

    def _follow(
        self, made: MapBundle, before: list[Pose | None], followers: list[TrackedView], refit_from: int
    ) -> None:
        """Move other views with the keyframe before them, and fit those from id `refit_from` on to the points."""
        key_ids = np.array([view.id for view in made.views])
        moved = set(key_ids.tolist())
        for view in followers:
            if view.pose is None or view.id in moved:
                continue
            at = max(int(np.searchsorted(key_ids, view.id)) - 1, 0)
            old, new = before[at], made.views[at].pose
            assert old is not None and new is not None
            turn = new.rotation @ old.rotation.T
            start = Pose(turn @ view.pose.rotation, new.centre + turn @ (view.pose.centre - old.centre))
            view.pose = start
            if view.id >= refit_from:
                fit = fit_pose(self.map, view, start)
                if fit.lost_reason() is None:
                    fit.store(view)
