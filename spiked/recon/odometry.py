"""The camera's path from sparse tracks: bootstrap, pose of every view, triangulation, and adjustment on a spline.

It needs no map of Gaussians, so a trajectory exists within a second or two; mapping then refines the same spline.
"""

import re
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

import spiked.native._odometry as _odometry
from spiked.pose import Array, exp_so3, log_so3, mean_rotation
from spiked.recon.bootstrap import INLIER_PX, LEAST_INLIERS, MIN_PARALLAX_PX, MORE_MOTION, SCALE_PX, Views
from spiked.recon.bundle import Bundle
from spiked.recon.certainty import path_error
from spiked.recon.edges import Edges
from spiked.recon.focal import CORRELATED, Focal, try_fields
from spiked.recon.movers import first_map
from spiked.recon.robust import median
from spiked.recon.smooth import Bursts, bursts, clock_of, coarsest
from spiked.recon.stamps import Stamps
from spiked.recon.tracks import Picture, Tracks, flow, search
from spiked.sensor import Intrinsics
from spiked.spline import Spline, Waypoints


class State(StrEnum):
    """What the tracker knows."""

    BOOT = "boot"
    TRACK = "track"
    DEGRADED = "degraded"
    LOST = "lost"
    RELOC = "reloc"


@dataclass
class Posed:
    """One view as the tracker sees it; rotation and centre are None until they are known."""

    time: float
    length: int
    """Frames of the window."""
    ids: NDArray[np.int64]
    pixels: Array
    motion_px: float
    state: State
    rotation: Array | None = None
    centre: Array | None = None
    unsure_px: float = 0.0
    """Noise of the tracks in this view alone, see `Stamps.level`."""
    inliers: float = 0.0
    """Share of the known points in view that agree with its pose."""
    chi2: float | None = None
    """Squared residual of a typical point over what the noise of the tracks explains; 1 is as it should be."""
    sigma_px: float | None = None
    """Predicted error of the pose, as the image at the median depth is displaced by it."""


@dataclass(frozen=True)
class Fit:
    """The outcome of aligning one view with known points."""

    rotation: Array
    centre: Array
    inliers: float
    points: int
    chi2: float = 1.0
    sigma_px: float = np.inf


BOOT_VIEWS = 10
MIN_POINTS = 15
LEAST_SEEN, LEAST_SPREAD_PX, PLACED_PX = 5, 0.5, 2.0
"""A track has a place in space when so many views saw it, along rays that spread by so much, and none sees the place so
far off."""
LEAST_BOUND = 3
"""A point is adjusted when so many of the views adjusted saw it."""
LEAST_NOISE_PX = 0.15
"""Points that were found lately are not yet better than this, however clean their tracks are."""
WORST_CHI2 = 2.5
WORST_SIGMA_PX = 1.0
WORST_INLIERS = 0.5
WORST_OVERLAP = 0.25
"""Tracking counts as degraded beyond any of these; overlap is the share of the tracks whose points are known."""
CERTAINTY = 5.0
"""How many times worse the whole path is than if all errors of tracks were independent: 4 (garden) to 7 (living)."""
WORST_PATH_ERROR = 0.03
"""A predicted error of the path, relative to its RMS radius, above which it counts as degraded and users are warned."""
STILL_PX = 0.12
"""Less motion from view to view than this is none: tracks are not better."""
STOOD_PX = 0.3
"""And so far from the first view of a bootstrap the camera has hardly moved: it may as well begin later."""
HOPELESS_CHI2 = 25.0
"""Beyond this, five times as far off as noise explains, the points contradict a pose: what was followed is not them."""
STRAY_NOISES, STRAY_PX = 6.0, (0.5, 2.0)
"""A point that lies off by so many times the noise of the tracks, within these bounds, in a third of its views is
forgotten: what moves slowly by itself would else stay."""
FOUND_CHI2 = 4.0
"""A place is found again only where points agree to twice their noise: smears seem to agree with much."""
RECALL_PX = (0.5, 4.0)
"""How exactly a point that is looked for where the pose says has to lead back to where it was seen, and how near that
place it may be found."""
LAST_VIEWS = 8
"""The state at the end is that of most of so many views: one noisy view says nothing about a recording."""
KEY_EVERY = 8
"""Every eighth posed view is kept for relocalisation."""
STEADY = 1.25
"""Tracks that fit worse than this many times the typical one do not help to find the focal length."""
FOCAL_ROUNDS = 4
SAME_FOCAL = 2e-3
"""In the end the whole path is adjusted so many times more, at most, until an unknown focal length changes no more than
this."""
FIT_SCALES_PX = (4.0, 2.0, 1.0, *[SCALE_PX] * 5)
"""Scales of the robust loss in the rounds that align one view."""
SLOW_FRAMES = 16
"""Shorter views see fast motion."""


@dataclass(frozen=True)
class Effort:
    """What the adjustment of the whole path may cost."""

    views: int
    """At most so many enter it."""
    free_views: int
    """And so many its first part, in which each has a pose of its own: that takes time with the cube of them."""
    rounds: int
    """Of each part, at most."""


WHOLE, MEANWHILE = Effort(100, 100, 8), Effort(32, 16, 3)
"""Kinks of fast motion take all of the views (with 32 of 100 free ones the error of garden_fast was 4 %), and so does
the last adjustment (the camera that walks forward had turns wrong by 0.011 degrees over 32 frames instead of 0.003)."""


@dataclass
class Odometry:
    """Feed views in order with `add`; `spline` is the path so far (None before the bootstrap), in frames."""

    intrinsics: Intrinsics
    seed: int = 0
    focal: Focal | None = None
    """Set where the focal length is to be estimated: `intrinsics` then follow it."""
    state: State = State.BOOT
    reason: str = "waiting for the first frames"
    views: list[Posed] = field(default_factory=list)
    points: Array = field(default_factory=lambda: np.full((0, 3), np.nan))
    """Position of every track by id, NaN where unknown."""
    spline: Spline | None = None
    sparse: bool = False
    """The views are so far apart that no spline can be tied to them: the path leads from each to the next, only the
    newest are adjusted together, and nothing takes much longer than a view."""
    path_error: float | None = None
    """Predicted error of the finished path relative to its RMS radius; None before the end."""
    changes: list[tuple[float, State, str]] = field(default_factory=list)
    """(time in frames, state, reason) of each change of state."""

    def __post_init__(self) -> None:
        self._tracks = Tracks()
        self._stamps = Stamps()
        self._adjusted: tuple[Bundle, Array] | None = None
        self._boot_start = 0
        self._boot_parallax = MIN_PARALLAX_PX
        self._boot_views = 0
        self._noise_px = 0.0
        self._next_global = 0
        self._keys: dict[int, Picture] = {}

    def pass_over(self) -> None:
        """From now on the views are far apart; see `sparse`."""
        self.sparse = self._tracks.far = True

    def add(
        self,
        time: float,
        length: int,
        picture: Picture,
        known: tuple[Array, Array] | None = None,
        edges: Edges | None = None,
        after_gap: bool = False,
    ) -> Posed:
        """Track one view of `length` frames around `time` and pose it if possible.

        `known` gives its pose, `edges` say when each pixel looked; `after_gap`: frames are missing before it.
        """
        motion = self._tracks.add(len(self.views), picture, after_gap)
        ids, at = self._tracks.ids.copy(), self._tracks.at.copy()
        late = np.zeros(len(ids)) if edges is None else edges.delays(picture, at)
        pixels, unsure = self._stamps.level(time, ids, at, late)
        posed = Posed(time, length, ids, pixels, motion, self.state, unsure_px=unsure)
        self.views.append(posed)
        if missing := self._tracks.next_id - len(self.points):
            self.points = np.concatenate([self.points, np.full((missing, 3), np.nan)])
        if known is not None:
            posed.rotation, posed.centre = known
            if len(self.views) % 8 == 0:
                self._triangulate(range(max(0, len(self.views) - 48), len(self.views)))
            self._become(State.TRACK, "poses are given")
        elif self.state is State.BOOT:
            self._try_bootstrap()
        else:
            self._pose_newest(picture)
        if posed.rotation is not None and (len(self.views) - 1) % KEY_EVERY == 0:
            self._keys[len(self.views) - 1] = picture
        posed.state = self.state
        return posed

    def _become(self, state: State, reason: str) -> None:
        if state is not self.state or _kind(reason) != _kind(self.reason):
            self.changes.append((self.views[-1].time, state, reason))
        self.state, self.reason = state, reason

    def end(self) -> None:
        """No more views will come: a last try to begin, then the adjustment of the whole path."""
        if self.state is State.BOOT and len(self.views) < BOOT_VIEWS:
            self.reason = f"the recording is too short: {len(self.views)} views, a first map needs {BOOT_VIEWS}"
        elif self.state is State.BOOT:
            self._try_bootstrap(final=True)
        self.settle()
        for _ in range(FOCAL_ROUNDS):
            before = self.intrinsics.fx
            if self.focal is None or self.spline is None:
                break
            self.settle()
            if abs(self.intrinsics.fx / before - 1) < SAME_FOCAL:
                break
        if self._adjusted is not None and self.spline is not None and not self.sparse:
            self.path_error = CERTAINTY * path_error(self._adjusted[0], self.spline, self._adjusted[1], SCALE_PX / 2)
        self._review()

    def information(self) -> Array | None:
        """How firmly the tracks hold `spline`, with all points free: [6 knots, 6 knots], inverse covariance of
        (rotation vector on the left, centre), as if their errors were independent. None before it was adjusted."""
        if self._adjusted is None or self.spline is None or not len(self._adjusted[0].camera):
            return None
        bundle, times = self._adjusted
        noise_px = max(bundle.noise_px(), 1e-3)
        return np.asarray(bundle.spline_information(self.spline, times, SCALE_PX / 2) / noise_px**2)

    def _review(self) -> None:
        """Judge every pose by the path and the points as they are in the end."""
        judged: list[tuple[Fit, int]] = []
        for view in self.views:
            if view.rotation is None or view.centre is None:
                continue
            fit = self._fit(view, view.rotation, view.centre, move=False)
            view.inliers, view.chi2, view.sigma_px = fit.inliers, fit.chi2, fit.sigma_px
            if view.state in (State.TRACK, State.DEGRADED):
                view.state = State.TRACK if self._doubt(fit, len(view.ids)) is None else State.DEGRADED
            judged.append((fit, len(view.ids)))
        if judged and self.state in (State.TRACK, State.DEGRADED):
            last = judged[-LAST_VIEWS:]
            doubtful = [one for one in last if self._doubt(*one) is not None]
            sound = [one for one in last if self._doubt(*one) is None]
            self._judge(*(doubtful if len(doubtful) > len(sound) else sound)[-1])
            if self.path_error is not None and self.path_error > WORST_PATH_ERROR:
                about = f"about {self.path_error:.0%}"
                self._become(
                    State.DEGRADED, f"the whole path's shape is only known to {about}: few tracks tie it together"
                )

    def _try_bootstrap(self, final: bool = False) -> None:
        newest = self.views[-1]
        start = self.views[self._boot_start]
        common = np.intersect1d(start.ids, newest.ids)
        while len(common) < 60 and self._boot_start < len(self.views) - BOOT_VIEWS:
            self._boot_start += 1
            start = self.views[self._boot_start]
            common = np.intersect1d(start.ids, newest.ids)
            self._boot_views = 0
        if len(common) >= 60 and self.views[self._boot_start + 1 :]:
            moved = np.linalg.norm(_pick(newest, common) - _pick(start, common), axis=1)
            if np.median(moved) < STOOD_PX:
                self._boot_start, self._boot_views = len(self.views) - 1, 0
        count = len(self.views) - self._boot_start
        if count < BOOT_VIEWS:
            self.reason = f"{count} of {BOOT_VIEWS} views for a first map: {MORE_MOTION}"
            return
        if (count % 3 or count < self._boot_views) and not final:
            return
        chosen = self._equal_flow()
        for k in chosen[1:-1]:
            common = np.intersect1d(common, self.views[k].ids)
        pixels = np.stack([_pick(self.views[k], common) for k in chosen])
        views = Views(pixels, common, self.intrinsics)
        if self.focal is None:
            verdict = first_map(views, self.seed, self._boot_parallax)
        else:
            verdict, self.intrinsics = try_fields(views, self.seed, self._boot_parallax)
        if verdict.winner is None:
            if verdict.tried:  # that took long: wait until there is clearly more to go by
                self._boot_parallax = max(MIN_PARALLAX_PX, 0.8 * verdict.wanted_parallax_px)
                self._boot_views = int(1.2 * count) + 1
            self._become(State.BOOT, verdict.reason)
            return
        bundle, self._noise_px, common = verdict.winner.bundle, verdict.winner.noise_px(), verdict.ids
        error = np.linalg.norm(bundle.residuals().reshape(len(chosen), -1, 2), axis=2)
        good = np.median(error, 0) < INLIER_PX
        self.points[common[good]] = bundle.points[good]
        for k, rotation, centre in zip(chosen, bundle.rotations, bundle.centres, strict=True):
            self.views[k].rotation, self.views[k].centre = rotation, centre
        self._pose_between(chosen)
        self._become(State.TRACK, f"bootstrap from {count} views, {verdict.winner.inliers:.0%} of the tracks agree")
        self._triangulate(range(self._boot_start, len(self.views)))
        self.settle()

    def _equal_flow(self) -> list[int]:
        """BOOT_VIEWS views from the first to the newest with about equal motion between them."""
        motion = np.array([v.motion_px for v in self.views[self._boot_start :]])
        motion[0] = 0
        path = np.cumsum(np.where(motion < STILL_PX, 0, motion) + 1e-3)
        at = np.searchsorted(path, np.linspace(path[0], path[-1], BOOT_VIEWS)).clip(0, len(path) - 1)
        return [self._boot_start + int(k) for k in np.unique(at)]

    def _pose_between(self, chosen: list[int]) -> None:
        for k in range(self._boot_start, len(self.views)):
            view = self.views[k]
            if view.rotation is None:
                near = self.views[chosen[int(np.argmin(np.abs(np.array(chosen) - k)))]]
                assert near.rotation is not None and near.centre is not None
                self._accept(view, self._fit(view, near.rotation, near.centre))
        for k in range(self._boot_start - 1, -1, -1):
            view, after = self.views[k], self.views[k + 1]
            assert after.rotation is not None and after.centre is not None
            fit = self._fit(view, after.rotation, after.centre)
            if fit.points < MIN_POINTS or fit.inliers < LEAST_INLIERS:
                break
            self._accept(view, fit)

    def _accept(self, view: Posed, fit: Fit) -> None:
        view.rotation, view.centre, view.inliers = fit.rotation, fit.centre, fit.inliers
        view.chi2, view.sigma_px = fit.chi2, fit.sigma_px

    def _pose_newest(self, picture: Picture) -> None:
        view = self.views[-1]
        known = [v for v in self.views[-40:-1] if v.rotation is not None]
        if not known:
            known = [v for v in self.views if v.rotation is not None][-2:]
        fit = self._fit(view, *predict(known[-2:], view.time))
        if (why := _hopeless(fit)) is not None:
            found = self._relocalise(picture)
            if found is None:
                if fit.chi2 > HOPELESS_CHI2:
                    self._tracks.forget()  # they follow smears: what they are now is not what they were
                self._become(State.LOST, f"{why}: {self._why_lost()}")
                return
            fit = found
        self._accept(view, fit)
        self._tie_newest(fit)

    def _tie_newest(self, fit: Fit) -> None:
        """Adjust what the newest view, just posed, adds to, and judge it by that."""
        view, count = self.views[-1], len(self.views)
        if count % 4 == 0:
            self._triangulate(range(max(0, count - 48), count))
        # Points that were found lately lie where few views put them: that they are off is no news before they were
        # adjusted together with the poses.
        off = fit.chi2 > WORST_CHI2 and fit.inliers > WORST_INLIERS
        if count >= self._next_global:
            self.settle(final=False)
        elif count % 8 == 0 or off:
            self._adjust_recent()
        if view.rotation is None or view.centre is None:
            self._become(State.LOST, f"the path as a whole contradicts this view: {self._why_lost()}")
            return
        if off:
            fit = self._fit(view, view.rotation, view.centre)
            self._accept(view, fit)
        self._judge(fit, len(view.ids))

    def _why_lost(self) -> str:
        """What a user may make of it."""
        if len(self.views[-1].ids) < 2 * MIN_POINTS:
            return "too little in view can be told apart (blank, dark or blurred)"
        return "the camera moved too fast to be followed, or something hides what it knew"

    def _judge(self, fit: Fit, tracks: int) -> None:
        if (why := self._doubt(fit, tracks)) is not None:
            self._become(State.DEGRADED, why)
        elif self.state is not State.TRACK:
            self._become(State.TRACK, "enough points agree again")

    def _doubt(self, fit: Fit, tracks: int) -> str | None:
        """Why a pose is to be taken with care, or None."""
        if fit.inliers < WORST_INLIERS or fit.points < 2 * MIN_POINTS:
            return f"{fit.points} known points in view, {fit.inliers:.0%} agree with one pose"
        if fit.sigma_px > WORST_SIGMA_PX:
            return f"the pose is only known to {fit.sigma_px:.1f} px: the known points leave much of the view empty"
        if fit.chi2 > WORST_CHI2:
            return f"points lie {np.sqrt(fit.chi2):.1f} times as far off as their noise explains"
        if fit.points < WORST_OVERLAP * tracks:
            return f"only {fit.points / tracks:.0%} of what is in view has been seen long enough to be known"
        return None

    def _fit(self, view: Posed, rotation: Array, centre: Array, move: bool = True) -> Fit:
        """Robust Gauss-Newton of one pose on the known points; without `move` it is only looked at."""
        points = self.points[view.ids]
        known = np.isfinite(points[:, 0])
        points, pixels = points[known], view.pixels[known]
        if len(points) < 6:
            return Fit(rotation, centre, 0.0, len(points))
        k = self.intrinsics
        rotation, centre = rotation.copy(), centre.copy()
        size, hessian = np.empty(len(points)), np.empty((6, 6))
        scales = np.array(FIT_SCALES_PX if move else FIT_SCALES_PX[-1:])
        _odometry.fit_pose(points, pixels, k.fx, k.fy, k.cx, k.cy, scales, rotation, centre, size, hessian, move)
        inliers = float(np.mean(size < 1.5 * INLIER_PX))
        noise = float(np.hypot(max(1.3 * self._noise_px, LEAST_NOISE_PX), view.unsure_px))
        chi2 = float((median(size) / (1.1774 * noise)) ** 2)
        depth = median((points - centre) @ rotation[:, 2])
        seen_px = _odometry.displacement(hessian, rotation, k.fx, k.fy, k.cx, k.cy, max(depth, 1e-6))
        return Fit(rotation, centre, inliers, len(points), chi2, float(np.sqrt(max(chi2, 1.0)) * noise * seen_px))

    def _relocalise(self, picture: Picture) -> Fit | None:
        """Find known points of earlier key views in this one; on success they become tracks again."""
        view = self.views[-1]
        numbers = sorted(self._keys)
        tried = numbers[-3:] + numbers[:-3][:: max(1, len(numbers) // 12)]
        for number in reversed(tried):
            key, ids, pixels = self._known(number)
            if len(ids) < MIN_POINTS or key.rotation is None or key.centre is None:
                continue
            at, good = search(self._keys[number], picture, pixels)
            if good.sum() < MIN_POINTS:
                continue
            view.ids, view.pixels = ids[good], at[good]
            fit = self._fit(view, key.rotation, key.centre)
            if fit.points >= MIN_POINTS and fit.inliers > 0.6 and fit.chi2 < FOUND_CHI2:
                fit = self._recall(picture, fit)
                self._tracks.resume(len(self.views) - 1, view.ids, view.pixels)
                self._become(State.RELOC, f"found again by {fit.points} points of earlier views")
                return fit
        view.ids, view.pixels = self._tracks.ids.copy(), self._tracks.at.copy()
        return None

    def _recall(self, picture: Picture, fit: Fit) -> Fit:
        """Also find the points of the other key views in the newest one, whose pose is about known now: each that is
        found again ties what follows to what was."""
        view, k = self.views[-1], self.intrinsics
        height, width = picture.shape
        for number in sorted(self._keys, reverse=True):
            _, ids, pixels = self._known(number)
            new = ~np.isin(ids, view.ids)
            ids, pixels = ids[new], pixels[new]
            local = (self.points[ids] - fit.centre) @ fit.rotation
            guess = local[:, :2] / np.maximum(local[:, 2:], 1e-6) * [k.fx, k.fy] + [k.cx, k.cy]
            inside = (local[:, 2] > 1e-6) & (guess > 8).all(1) & (guess < [width - 8, height - 8]).all(1)
            if not inside.any():
                continue
            ids, guess = ids[inside], guess[inside]
            at, good = flow(self._keys[number], picture, pixels[inside], guess, RECALL_PX[0], levels=1)
            good &= np.linalg.norm(at - guess, axis=1) < RECALL_PX[1]
            view.ids, view.pixels = np.concatenate([view.ids, ids[good]]), np.concatenate([view.pixels, at[good]])
        fit = self._fit(view, fit.rotation, fit.centre)
        local = (self.points[view.ids] - fit.centre) @ fit.rotation
        there = local[:, :2] / np.maximum(local[:, 2:], 1e-6) * [k.fx, k.fy] + [k.cx, k.cy]
        agree = np.linalg.norm(there - view.pixels, axis=1) < 2 * INLIER_PX
        view.ids, view.pixels = view.ids[agree], view.pixels[agree]
        return self._fit(view, fit.rotation, fit.centre)

    def _triangulate(self, span: range) -> None:
        """Positions for tracks that have none, from the posed views of `span`."""
        posed = [(v, v.rotation, v.centre) for v in self.views[span.start : span.stop] if v.rotation is not None]
        if not posed:
            return
        seen = np.repeat(np.arange(len(posed)), [len(view.ids) for view, _, _ in posed])
        ids, pixels = (np.concatenate(one) for one in zip(*((v.ids, v.pixels) for v, _, _ in posed), strict=True))
        rotations, centres = np.array([r for _, r, _ in posed]), np.array([c for _, _, c in posed])
        k, spread_px = self.intrinsics, max(LEAST_SPREAD_PX, 3 * self._noise_px)
        lens = k.fx, k.fy, k.cx, k.cy
        _odometry.place(rotations, centres, seen, ids, pixels, *lens, LEAST_SEEN, spread_px, PLACED_PX, self.points)

    def _bundle(self, numbers: list[int]) -> tuple[Bundle, NDArray[np.int64]] | None:
        """A bundle of the posed views `numbers` and all points seen three times or more in them, with their ids."""
        views = [self.views[n] for n in numbers]
        ids, pixels = (np.concatenate(one) for one in zip(*((v.ids, v.pixels) for v in views), strict=True))
        used = (np.bincount(ids, minlength=len(self.points)) >= LEAST_BOUND) & np.isfinite(self.points[:, 0])
        keep = used[ids]
        if keep.sum() < 60:
            return None
        camera = np.repeat(np.arange(len(views)), [len(v.ids) for v in views])[keep]
        point = (np.cumsum(used) - 1)[ids[keep]]
        rotations = np.stack([v.rotation for v in views if v.rotation is not None])
        centres = np.stack([v.centre for v in views if v.centre is not None])
        bundle = Bundle(rotations, centres, self.points[used], camera, point, pixels[keep], self.intrinsics)
        return bundle, np.flatnonzero(used)

    def _known(self, number: int) -> tuple[Posed, NDArray[np.int64], Array]:
        view = self.views[number]
        keep = np.isfinite(self.points[view.ids, 0])
        return view, view.ids[keep], view.pixels[keep]

    def _adjust_recent(self, free: int = 10, fixed: int = 4, older: int = 4, reach: int = 40) -> None:
        """Adjust the newest poses and what they see; some before them, near and far, hold place and scale."""
        posed = [
            n for n in range(max(0, len(self.views) - reach), len(self.views)) if self.views[n].rotation is not None
        ]
        near = posed[-free - fixed :]
        far = posed[: -free - fixed]
        numbers = far[:: -(-len(far) // older) or 1] + near
        made = self._bundle(numbers) if len(numbers) > fixed + 2 else None
        if made is None:
            return
        bundle, ids = made
        frozen = np.ones(len(numbers), bool)
        frozen[max(fixed, len(numbers) - free) :] = False
        bundle.optimise(3, SCALE_PX, frozen, tolerance=1e-3)
        self._take(bundle, ids, numbers)

    def _take(self, bundle: Bundle, ids: NDArray[np.int64], numbers: list[int]) -> None:
        """Poses and points from an adjusted bundle; points that do not fit are forgotten."""
        for n, rotation, centre in zip(numbers, bundle.rotations, bundle.centres, strict=True):
            self.views[n].rotation, self.views[n].centre = rotation, centre
        error = np.linalg.norm(bundle.residuals(), axis=1)
        stray = error > np.clip(STRAY_NOISES * bundle.noise_px(), *STRAY_PX)
        bad = np.bincount(bundle.point, stray, len(ids)) > 0.3 * np.bincount(bundle.point, minlength=len(ids))
        self.points[ids] = np.where(bad[:, None], np.nan, bundle.points)

    def triangulate_all(self) -> None:
        """Positions for all tracks, for paths that are known from elsewhere."""
        self._triangulate(range(len(self.views)))

    def waypoints(self) -> Waypoints | None:
        """The path from each posed view to the next; None before the bootstrap."""
        posed = [(v.time, v.rotation, v.centre) for v in self.views if v.rotation is not None and v.centre is not None]
        if len(posed) < 2:
            return None
        times, rotations, centres = zip(*posed, strict=True)
        return Waypoints(np.array(times), np.stack(rotations), np.stack(centres))

    def settle(self, final: bool = True) -> None:
        """Adjust the whole path: freely first, then on the coarsest spline that follows it. Where it is not `final` and
        the motion is slow, with fewer views and rounds, unless these contradict each other."""
        if self.sparse:
            return
        posed = [n for n, v in enumerate(self.views) if v.rotation is not None]
        self._next_global = max(len(self.views) + 12, int(1.5 * len(self.views)))
        if len(posed) < BOOT_VIEWS:
            return
        effort = WHOLE if final or self.views[-1].length < SLOW_FRAMES else MEANWHILE
        numbers = self._spread(posed, effort.views)
        start = self._freely(self._spread(numbers, effort.free_views), effort.rounds)
        made = self._bundle(numbers)
        if start is None or made is None:
            return
        bundle, ids = made
        every = ids
        times = np.array([self.views[n].time for n in numbers])
        bundle.rotations, bundle.centres = start.poses(times)
        if self.focal is not None:
            bundle.focal_free = True
            bundle, ids = _steady(bundle, ids)
        spline, _ = bundle.optimise_spline(start, times, effort.rounds, SCALE_PX / 2, tolerance=1e-3)
        if (wrong := self._contradicted(bundle, numbers)) and len(posed) - len(wrong) >= BOOT_VIEWS:
            if effort is not WHOLE:  # too few views to say so
                self.settle()
                return
            for n in wrong:  # smeared views, posed by what they seemed to show, would bend the path
                self.views[n].rotation = self.views[n].centre = None
                self.views[n].state = State.LOST
            self.settle(final)
            return
        self._noise_px = bundle.noise_px()
        if self.focal is not None:
            self.points[np.setdiff1d(every, ids)] = np.nan  # found again below, where the path then says
            self.intrinsics = bundle.intrinsics
            self.focal = Focal(self.intrinsics, CORRELATED * bundle.focal_sigma(SCALE_PX))
        self.spline = self._in_old_frame(spline, bundle, numbers)
        self._adjusted = bundle, times
        self._take(bundle, ids, numbers)
        others = [n for n in posed if n not in set(numbers)]
        if others:
            rotations, centres = self.spline.poses([self.views[n].time for n in others])
            for n, rotation, centre in zip(others, rotations, centres, strict=True):
                self.views[n].rotation, self.views[n].centre = rotation, centre
        self._triangulate(range(max(0, len(self.views) - 2 * effort.views), len(self.views)))

    def _contradicted(self, bundle: Bundle, numbers: list[int]) -> list[int]:
        """Which of the views `numbers` are where the points, adjusted with them in a bundle, say that they are not."""
        size = np.linalg.norm(bundle.residuals(), axis=1)
        noise = max(1.3 * bundle.noise_px(), LEAST_NOISE_PX)
        chi2 = np.zeros(len(numbers))
        for row, n in enumerate(numbers):
            seen = size[bundle.camera == row]
            if len(seen):
                chi2[row] = (median(seen) / (1.1774 * np.hypot(noise, self.views[n].unsure_px))) ** 2
        # Their neighbours on a spline are drawn along: only the worst of each few are wrong for sure.
        around = np.lib.stride_tricks.sliding_window_view(np.pad(chi2, 2), 5).max(1)
        return [n for n, own, most in zip(numbers, chi2, around, strict=True) if own > HOPELESS_CHI2 and own == most]

    def _freely(self, numbers: list[int], rounds: int) -> Spline | None:
        """The coarsest spline that follows some views, each adjusted freely with the points; these stay adjusted."""
        made = self._bundle(numbers)
        if made is None:
            return None
        bundle, ids = made
        bundle.focal_free = self.focal is not None
        bundle.optimise(rounds, SCALE_PX, tolerance=1e-3)
        self.points[ids], self.intrinsics = bundle.points, bundle.intrinsics
        return self._coarsest(np.array([self.views[n].time for n in numbers]), bundle)

    def _spread(self, posed: list[int], most: int) -> list[int]:
        """At most so many of these views with the first and the last, fewer of them where little moves."""
        if len(posed) <= most:
            return posed
        motion = np.array([self.views[n].motion_px for n in posed])
        path = np.cumsum(np.minimum(motion, 2 * np.median(motion)) + 0.3 * motion.mean() + 1e-3)
        at = np.searchsorted(path, np.linspace(path[0], path[-1], most)).clip(0, len(posed) - 1)
        return [posed[int(k)] for k in np.unique(at)]

    def _in_old_frame(self, spline: Spline, bundle: Bundle, numbers: list[int]) -> Spline:
        """The adjusted path and points, carried by a similarity to where they were, so that a map stays valid."""
        views = [self.views[n] for n in numbers]
        old_centres = np.stack([v.centre for v in views if v.centre is not None])
        old_rotations = np.stack([v.rotation for v in views if v.rotation is not None])
        rotation = mean_rotation(old_rotations @ bundle.rotations.swapaxes(1, 2))
        a, b = bundle.centres @ rotation.T, old_centres
        middle_a, middle_b = a.mean(0), b.mean(0)
        scale = ((a - middle_a) * (b - middle_b)).sum() / max(((a - middle_a) ** 2).sum(), 1e-12)

        def carry(points: Array) -> Array:
            return np.asarray(scale * (points @ rotation.T - middle_a) + middle_b)

        bundle.points, bundle.centres = carry(bundle.points), carry(bundle.centres)
        bundle.rotations = rotation @ bundle.rotations
        return replace(spline, rotations=rotation @ spline.rotations, centres=carry(spline.centres))

    def _bursts(self, times: Array, bundle: Bundle) -> Bursts:
        """Where a bundle's views, at `times`, say that the camera moved much faster than before and after."""
        turns = np.linalg.norm(log_so3(bundle.rotations[1:] @ bundle.rotations[:-1].swapaxes(1, 2)), axis=1)
        depth = np.median(
            ((bundle.points[bundle.point] - bundle.centres[bundle.camera])[:, None] @ bundle.rotations[bundle.camera])[
                :, 0, 2
            ]
        )
        shifts = np.linalg.norm(np.diff(bundle.centres, axis=0), axis=1) / max(depth, 1e-6)
        return bursts(times, self.intrinsics.fx * (turns + shifts))

    def _coarsest(self, times: Array, bundle: Bundle) -> Spline:
        margin = 0.5 * max(v.length for v in self.views)
        span = (self.views[0].time - margin, self.views[-1].time + margin)
        hessians = bundle.pose_hessians(SCALE_PX)
        still = np.array([v.motion_px < STILL_PX for v in self.views])
        clock = clock_of(np.array([v.time for v in self.views]), still, self._bursts(times, bundle))
        return coarsest(times, bundle.rotations, bundle.centres, hessians, len(bundle.camera), span, clock)


def _steady(bundle: Bundle, ids: NDArray[np.int64]) -> tuple[Bundle, NDArray[np.int64]]:
    """The bundle without the tracks that fit worst; all stay where a view would be left with few.

    They slide along edges or sit where two surfaces meet and err the same way for long: with them the focal length of
    living was 3.2 % off, without 2.2 %.
    """
    seen = np.bincount(bundle.point, minlength=len(ids))
    square = np.minimum((bundle.residuals() ** 2).sum(1), INLIER_PX**2)
    rms = np.sqrt(np.bincount(bundle.point, square, len(ids)) / np.maximum(seen, 1))
    keep = rms[bundle.point] < STEADY * np.median(rms)
    views = len(bundle.centres)
    if np.bincount(bundle.camera[keep], minlength=views).min() < 3 * MIN_POINTS:
        return bundle, ids
    left, point = np.unique(bundle.point[keep], return_inverse=True)
    kept = replace(
        bundle, points=bundle.points[left], camera=bundle.camera[keep], point=point, pixels=bundle.pixels[keep]
    )
    return kept, ids[left]


def _hopeless(fit: Fit) -> str | None:
    """Why a view cannot be where the points say, or None."""
    if fit.points < MIN_POINTS or fit.inliers < 0.35:
        return f"{fit.points} known points in view, {fit.inliers:.0%} agree with one pose"
    if fit.chi2 > HOPELESS_CHI2:
        return f"points lie {np.sqrt(fit.chi2):.0f} times as far off as their noise explains"
    return None


def _kind(reason: str) -> str:
    """A reason without its figures: the same kind again is no news."""
    return re.sub(r"[0-9.]+", "#", reason)


def _pick(view: Posed, ids: NDArray[np.int64]) -> Array:
    order = np.argsort(view.ids)
    return np.asarray(view.pixels[order[np.searchsorted(view.ids, ids, sorter=order)]])


def predict(last: list[Posed], time: float) -> tuple[Array, Array]:
    """The pose at `time` from the last one or two posed views at constant velocity."""
    b = last[-1]
    assert b.rotation is not None and b.centre is not None
    if len(last) == 1:
        return b.rotation, b.centre
    a = last[-2]
    assert a.rotation is not None and a.centre is not None
    u = (time - b.time) / max(b.time - a.time, 1e-9)
    return b.rotation @ exp_so3(u * log_so3(a.rotation.T @ b.rotation)), b.centre + u * (b.centre - a.centre)
