"""The seconds of work that a reconstruction has left: a plan of its parts, priced by what they have taken so far.

The work of each part is stated in seconds of a reference machine. Its pace, measured over reference seconds, is that of
the part itself once it has run, and before that of the parts that have.
"""

import os
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from spiked.recon.frontend.windowing import MOST_SPACING_S, SPACING_PX
from spiked.recon.mapping.mapper import LARGE_PIXELS
from spiked.recon.mapping.options import MapOptions
from spiked.recon.mapping.pyramid import SMALLEST_PIXELS
from spiked.recon.odometry.long_paths import LONG_FRAMES
from spiked.sensor import Sensor

REFERENCE_PIXELS = 100_000
"""Pixels of the images that the constants below were measured with: 400x250, on two cores of an AMD EPYC (Zen 4,
AVX-512)."""
VIEW_S, VIEW_POWER = 0.0165, 1.2
"""Time to track one view, and the power of its pixels with which it grows: 14 ms on living and 18 on the walk, 240 on
camp_color, whose images have ten times the pixels."""
SHORT_END, LONG_END = 0.17, 0.5
"""Time of the end of the tracking over that of the tracking: living 0.2, camp_color 0.08; walks of 10 and 60 s 0.5 and
0.58."""
SWEPT_VIEW_S = 0.4
"""Time to sweep one view for depth, whatever the size of the sensor."""
STEP_S, STEP_SPLATS, STEP_POWER = 0.040, 60_000, 0.3
"""Time of a step on living with `FULL_SPLATS`. It grows with the splats and `STEP_SPLATS` more, and with a power of the
pixels: camp_color's steps at 1/16, 1/4 and all of its pixels are as 1 to 1.6 to 2.2 for one number of splats."""
FULL_SPLATS = 80_000
"""Most splats of the map of a short path at 400x250, as on living."""
COLOUR_WORK = 1.9
"""Steps on colours or on charges over those on grey rates."""
ALIGNED_VIEW = 0.65
"""Time of a view in an alignment over that of a step: living 0.6, camp_color 0.75."""
PRUNED_VIEW = 0.8
"""Time of a view in a pruning over that of a step: the walk's first second."""
PRUNED_SHARE = 0.37
"""Splats that a pruning removes: the walk's first second, twice."""
SEEDED_SHARE = 0.35
"""Splats after the seeding over the most that a map has: living .32, camp_color .36."""
MEMORY_S = 10.0
"""Reference seconds over which a pace is averaged: other programs come and go."""
SURE_S = 0.3
"""Reference seconds after which a part's own pace counts as much as that of the others."""
REFERENCE_THREADS, MOST_THREADS = 2, 16
"""The refinement's time is taken to fall with the number of threads up to here; the tracking runs on one."""
STEP_SAMPLES = 24
"""Steps at which the work of those that are left is computed."""
TELL_S = 0.2
"""Time from one prediction to the next: one takes 0.3 ms."""
TYPICAL_SPEED_PX = 0.0173
"""Image motion a frame of a hand-held camera: the walk's 3,460 px in 200,000 frames. For recordings that wait."""
TYPICAL_VIEW_FRAMES = 20
"""Frames a view of a path that is not long: living has 78 views in 1,280 frames."""
TYPICAL_KEPT = 400
"""Views that are kept for the map, at most, by default."""


class Part(StrEnum):
    """A part of the work."""

    TRACKING = "tracking"
    ENDING = "ending"
    SEEDING = "seeding"
    STEPS = "steps"
    ALIGNING = "aligning"
    PRUNING = "pruning"


@dataclass
class Pace:
    """Seconds a reference second, of one part."""

    work_s: float = 0.0
    seconds: float = 0.0

    def add(self, work_s: float, seconds: float) -> None:
        """Work that took some time; older work fades."""
        fade = float(np.exp(-work_s / MEMORY_S))
        self.work_s = fade * self.work_s + work_s
        self.seconds = fade * self.seconds + seconds

    def value(self, usual: float) -> float:
        """The pace; `usual` is that of the other parts."""
        return (self.seconds + SURE_S * usual) / (self.work_s + SURE_S)


@dataclass(frozen=True)
class RefinementPlan:
    """What a refinement consists of."""

    steps: int
    swept_views: int
    align_at: tuple[float, ...]
    """Shares at which the path is aligned; empty: it is not."""
    aligned_views: int
    """Views in an alignment of the path."""
    pruned_views: int
    """Views in a pruning of the map; 0: it is not pruned."""
    pixels: int
    """Of the sensor."""
    most_splats: int
    coloured: bool
    fast: bool
    """Most views see fast motion: steps compare charges."""
    options: MapOptions
    threads: int | None = None

    @property
    def scale(self) -> float:
        """Reference seconds over those of `REFERENCE_THREADS`, by the number of threads."""
        threads = self.threads or len(os.sched_getaffinity(0))
        return REFERENCE_THREADS / min(threads, MOST_THREADS)

    def seeding_s(self) -> float:
        """Work of the seeding."""
        return self.scale * SWEPT_VIEW_S * self.swept_views

    def step_s(self, done: float, splats: float) -> float:
        """Work of the step after `done` others."""
        schedule = self.options.schedule
        level = int(np.ceil(schedule.coarseness(done / max(self.steps, 1)) * (_levels(self.pixels) - 1)))
        return self._step_s(self.pixels / 4**level, splats)

    def _step_s(self, pixels: float, splats: float) -> float:
        size = float((pixels / REFERENCE_PIXELS) ** STEP_POWER)
        full = (splats + STEP_SPLATS) / (FULL_SPLATS + STEP_SPLATS)
        return self.scale * STEP_S * size * full * (COLOUR_WORK if self.coloured or self.fast else 1.0)

    def steps_s(self, done: int, splats: int) -> float:
        """Work of the steps that are left, with so many splats now: densification adds some, prunings remove some."""
        each = (self.steps - done) / STEP_SAMPLES
        if each <= 0:
            return 0.0
        densify, pruning = self.options.densification, self.options.pruning
        now, total = float(splats), 0.0
        pruned = pruning.due(done / self.steps)
        for at in done + each * (np.arange(STEP_SAMPLES) + 0.5):
            share = at / self.steps
            if self.pruned_views and pruning.due(share) > pruned:
                pruned, now = pruning.due(share), now * (1 - PRUNED_SHARE)
            if share < densify.until:
                added = densify.share_of(self.fast) * self.most_splats * each / densify.every
                now = max(now, min(now + added, self.most_splats))
            total += each * self.step_s(float(at), now)
        return total

    def alignments_due(self, share: float) -> int:
        """Number of alignments that should have been made when that share is done."""
        return sum(share >= at for at in self.align_at)

    def aligning_s(self, splats: float) -> float:
        """Work of one alignment."""
        large = self.coloured or self.fast or self.pixels > LARGE_PIXELS
        pixels = self.pixels / 4 if large and _levels(self.pixels) > 1 else self.pixels
        return ALIGNED_VIEW * self.aligned_views * self._step_s(pixels, splats)

    def pruning_s(self, splats: float) -> float:
        """Work of one pruning."""
        return PRUNED_VIEW * self.pruned_views * self._step_s(self.pixels, splats)

    def work(self, done: int | None, splats: int) -> dict[Part, float]:
        """Work that is left of each part after `done` steps; None: the map is not seeded."""
        share = (done or 0) / max(self.steps, 1)
        if done is None:
            splats = round(SEEDED_SHARE * self.most_splats)
        pruning = self.options.pruning
        full = max(self.most_splats, splats)
        return {
            Part.SEEDING: self.seeding_s() if done is None else 0.0,
            Part.STEPS: self.steps_s(done or 0, splats),
            Part.ALIGNING: (len(self.align_at) - self.alignments_due(share)) * self.aligning_s((splats + full) / 2),
            Part.PRUNING: (len(pruning.at) - pruning.due(share)) * self.pruning_s(full),
        }


def _levels(pixels: float) -> int:
    """Levels of the image pyramid."""
    count = 1
    while pixels / 4**count >= SMALLEST_PIXELS:
        count += 1
    return count


@dataclass
class TimeLeft:
    """Measures the parts of one reconstruction as they are done, and predicts the rest.

    `start` begins the clock, `lap` attributes the time since the last of both to a part.
    """

    frames: int | None = None
    """Frames that will have been fed at the end; None while that is not known."""
    end_left: float = 1.0
    """Share of the end of the tracking that is left."""
    _paces: dict[Part, Pace] = field(default_factory=lambda: {part: Pace() for part in Part})
    _tracked_s: float = 0.0
    """Reference seconds of all tracking."""
    _recent: list[tuple[int, int]] = field(default_factory=list)
    """(frames, views) of the tracking, at some times."""
    _since: float = 0.0
    _deadline: float = np.inf
    _told: tuple[float, float | None] = (-np.inf, None)
    """When seconds were predicted last, and what."""

    def __getstate__(self) -> dict[str, object]:
        """For a checkpoint: times of this process mean nothing to the next one."""
        return vars(self) | {"_since": 0.0, "_deadline": np.inf, "_told": (-np.inf, None)}

    def expect(self, frames: int) -> None:
        """Set the number of frames that will have been fed at the end."""
        self.frames, self._told = frames, (-np.inf, None)

    def start(self, deadline: float | None = None) -> None:
        """Begin to measure. `deadline`, of `time.perf_counter`: when the refinement ends at the latest."""
        self._since = time.perf_counter()
        self._deadline = self._deadline if deadline is None else deadline

    def lap(self, part: Part, work_s: float) -> None:
        """What was done since the last call."""
        now = time.perf_counter()
        self._paces[part].add(work_s, now - self._since)
        self._since = now

    def tracked(self, frames: int, views: int, new: int, sensor: Sensor) -> None:
        """Views were tracked: `new` of them since the last call, all in all `views` in `frames`."""
        work_s = new * view_s(sensor.width * sensor.height)
        self._tracked_s += work_s
        self.lap(Part.TRACKING, work_s)
        self._recent.append((frames, views))

    def ended(self, left: float, long: bool) -> None:
        """The end of the tracking has come to a share that is left."""
        self.lap(Part.ENDING, (self.end_left - left) * self._ending_s(long))
        self.end_left = left

    def _ending_s(self, long: bool, more_s: float = 0.0) -> float:
        return (LONG_END if long else SHORT_END) * (self._tracked_s + more_s)

    def tracking(self, long: bool, speed_px: float, sensor: Sensor) -> dict[Part, float]:
        """Work that is left of the tracking, at an image motion of `speed_px` a frame."""
        if self.frames is None or not self._recent:
            return {}
        at, views = self._recent[-1]
        earlier = next((one for one in reversed(self._recent) if at - one[0] >= LONG_FRAMES / 4), (0, 0))
        a_frame = (views - earlier[1]) / max(at - earlier[0], 1)
        left = max(self.frames - at, 0)
        spaced = 0 if long else min(max(self.frames - LONG_FRAMES, 0), left)
        spacing = min(SPACING_PX / max(speed_px, 1e-6), MOST_SPACING_S * sensor.frame_rate_hz)
        more = (left - spaced) * a_frame + spaced * min(a_frame, 1 / spacing)
        more_s = more * view_s(sensor.width * sensor.height)
        long = long or spaced > 0
        return {Part.TRACKING: more_s, Part.ENDING: self.end_left * self._ending_s(long, more_s)}

    def told(self, work: Callable[[], dict[Part, float] | None]) -> float | None:
        """`seconds` of the work that is left, or None; it is asked for at most every `TELL_S`."""
        now = time.perf_counter()
        if now - self._told[0] >= TELL_S:
            left = work()
            self._told = now, None if left is None else self.seconds(left)
        at, seconds = self._told
        return None if seconds is None else max(0.0, seconds - (now - at))

    def seconds(self, work: dict[Part, float]) -> float:
        """Seconds that work takes."""
        done = sum(pace.work_s for pace in self._paces.values())
        usual = Pace(done, sum(pace.seconds for pace in self._paces.values())).value(1.0)
        left = sum(self._paces[part].value(usual) * work_s for part, work_s in work.items())
        return max(0.0, min(left, self._deadline - time.perf_counter()))


def view_s(pixels: int) -> float:
    """Work to track a view."""
    return VIEW_S * float((pixels / REFERENCE_PIXELS) ** VIEW_POWER)


def typical_work_s(width: int, height: int, frames: int, steps: int, options: MapOptions | None = None) -> float:
    """Reference seconds of a reconstruction by the size of its recording, for the order of those that wait."""
    options, pixels = options or MapOptions(), width * height
    short = min(frames, LONG_FRAMES)
    views = short / TYPICAL_VIEW_FRAMES + (frames - short) * TYPICAL_SPEED_PX / SPACING_PX
    long = frames > LONG_FRAMES
    tracking_s = views * view_s(pixels) * (1 + (LONG_END if long else SHORT_END))
    extent = max(1.0, frames * TYPICAL_SPEED_PX / options.extent_px)
    most = min(round(options.splats_a_pixel * pixels * extent), options.most_splats)
    extent = max(1.0, min(extent, most / (options.splats_a_pixel * pixels)))
    plan = RefinementPlan(
        options.schedule.steps(steps, pixels, 0.0, extent),
        round(options.seeding.views * extent),
        options.schedule.align_long_at if long else (),
        min(round(views), TYPICAL_KEPT),
        options.pruning.views if long else 0,
        pixels,
        most,
        coloured=False,
        fast=False,
        options=options,
        threads=REFERENCE_THREADS,
    )
    return tracking_s + sum(plan.work(None, 0).values())
