"""`ViewTracker`: cuts frames into views, tracks them and stores them."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spiked.errors import ConfigurationError
from spiked.pose import Array
from spiked.recon import report
from spiked.recon.frontend.feature_tracks import Picture, picture, smoothed, white_of
from spiked.recon.frontend.mosaic_check import layout_warnings
from spiked.recon.frontend.recorded_views import RecordedFrames, RecordedViews
from spiked.recon.frontend.windowing import View, Windows, luminance
from spiked.recon.given_poses import GivenPoses
from spiked.recon.methods import Initialisation
from spiked.recon.odometry.keyframe_pictures import KeyframePictures
from spiked.recon.odometry.odometry import Odometry
from spiked.recon.odometry.self_calibration import EstimatedLens, Focal
from spiked.recon.options import Options
from spiked.recon.untracked import UntrackedOdometry
from spiked.recon.view_choice import choose
from spiked.recon.view_store import ViewStore
from spiked.sensor import Intrinsics, Response, Sensor
from spiked.spline import Path, Waypoints

KEYFRAME_SHARE = 0.125
"""Share of `Options.memory_mb` for the images of keyframes: a byte a pixel, while those of views take three or more."""
BRIDGED_S = 0.1
"""Longest time between tracked views, where frames were skipped, over which the path is interpolated. A hand differs
from it by 0.06, 0.2 and 0.6 % of the walk's radius over 30, 50 and 100 ms (decision 63)."""
LEAST_VIEWS = 10
"""Views with a pose that a map needs."""


class ViewTracker:
    """From frames to views with poses, before any map corrects them."""

    def __init__(
        self,
        sensor: Sensor,
        intrinsics: Intrinsics,
        focal: Focal | None,
        options: Options,
        live: bool,
        recording: RecordedFrames | None,
    ) -> None:
        """`intrinsics` are those to begin with, `focal` is set where they are estimated; others: see `Reconstructor`.

        Raises ConfigurationError where the initialisation needs known intrinsics.
        """
        targets, memory_bytes = options.targets, options.memory_mb * 2**20
        self.sensor, self.options = sensor, options
        recorded = None if recording is None else RecordedViews(recording, sensor, options.calibration, targets)
        self.views = ViewStore(options.max_views, (1 - KEYFRAME_SHARE) * memory_bytes, recorded)
        """One record a view."""
        pictures = KeyframePictures(KEYFRAME_SHARE * memory_bytes, None if recording is None else _Pictures(self))
        self.untracked = options.parts.initialisation is Initialisation.PROGRESSIVE
        """Views have no tracks, and the map alone estimates the path."""
        if self.untracked and focal is not None:
            raise ConfigurationError(
                f"the focal length is not known, and the initialisation {Initialisation.PROGRESSIVE} has no tracks to "
                "estimate it from: give --fov DEGREES or --intrinsics fx,fy,cx,cy"
            )
        made = UntrackedOdometry if self.untracked else Odometry
        self.odometry = made(intrinsics, options.seed, focal, live, pictures)
        """Poses and points of the views."""
        self.windows = Windows(sensor, options.window_frames, options.calibration, targets)
        """The frames that later views need."""
        self.given = None if options.poses is None else GivenPoses(options.poses, sensor.frame_rate_hz)
        """Poses that are not estimated."""
        self.warnings: list[str] = []
        """Warnings about the recording, one sentence each."""
        self.gaps: list[tuple[int, int]] = []
        """(first frame, number) of the lost frames."""
        self.frames = 0
        """Frames so far, lost ones included."""
        self.posed_views = 0
        """Views that had a pose when they were tracked."""
        self.unit = 1.0
        """Length of the map's unit in the trajectory's unit."""
        self.ended = False
        """All frames are tracked, and the path is final up to its alignment with the map."""
        self._preview = np.empty((sensor.height, sensor.width), np.float32)
        self._after_gap = True
        self._waypoints: tuple[int, Path | None] = (-1, None)

    def __getstate__(self) -> dict[str, object]:
        """For a checkpoint: without what is made anew."""
        return {name: value for name, value in vars(self).items() if name != "_preview"}

    def __setstate__(self, state: dict[str, object]) -> None:
        vars(self).update(state)
        self._preview = np.empty((self.sensor.height, self.sensor.width), np.float32)
        self.odometry.build_images_with(_Pictures(self))

    def feed(self, first_frame: int, frames: NDArray[np.uint8]) -> bool:
        """Add stored frames uint8 [n, frame_bytes]; returns whether images of views were dropped."""
        dropped = self._track_all(self.windows.feed(first_frame, frames))
        self.frames = first_frame + len(frames)
        return dropped

    def track_latest(self, first_frame: int, frames: NDArray[np.uint8]) -> bool:
        """Track one view in the middle of frames, not those before; returns whether images of views were dropped."""
        self.odometry.skip()
        dropped = self._track(self.windows.latest_view(first_frame, frames), skipped=True)
        self.frames = first_frame + len(frames)
        return dropped

    def gap(self, first_frame: int, count: int) -> None:
        """Frames [first_frame, first_frame + count) were lost."""
        self.gaps.append((first_frame, count))
        self._after_gap = True

    def flush(self) -> bool:
        """Track the frames that are buffered, the last ones; returns whether images of views were dropped."""
        return self._track_all(self.windows.flush())

    def end(self, stop: Callable[[], bool], save: Callable[[], None], preliminary: bool = False) -> None:
        """After `flush`: adjust the whole path. The arguments: see `Odometry.end`."""
        if self.given is None:
            self.odometry.end(stop, save, preliminary)
            self._waypoints = -1, None  # the views have moved
        else:
            self.unit = self.odometry.end_with_path(self.given.path(self.frames), 0.5 * self.frames) or 1.0

    def choose_views(self, focal_px: float) -> bool:
        """Keep those views of a long path that add something to a map; returns whether others were dropped."""
        if not isinstance(path := self.path, Waypoints):
            return False
        chosen = choose(self.views.candidates(path), self.odometry.points, focal_px, self.options.max_views)
        if len(chosen) < LEAST_VIEWS:
            return False
        self.views.keep(chosen)
        return True

    def warn_of_path(self) -> None:
        """Add the warnings about the finished path."""
        found = report.path_warning(self.odometry.path_error), self.odometry.remark
        self.warnings += [warning for warning in found if warning is not None]

    @property
    def path(self) -> Path | None:
        """The tracked path in frames and map units; None before the bootstrap."""
        if not self.odometry.sparse:
            return self.odometry.spline
        if self._waypoints[0] != len(self.views):
            self._waypoints = len(self.views), self.odometry.waypoints()
        return self._waypoints[1]

    @property
    def points(self) -> Array:
        """The known landmarks [N, 3]."""
        return self.odometry.points[np.isfinite(self.odometry.points[:, 0])]

    @property
    def estimated(self) -> list[Focal | EstimatedLens]:
        """What was estimated of the optics."""
        return [one for one in (self.odometry.focal, self.odometry.lens) if one is not None]

    @property
    def speed_px(self) -> float | None:
        """Image motion in px a frame between the two newest views; None without tracks."""
        if len(self.views) < 2 or not self.views[-1].tracked.motion_px:
            return None
        return self.views[-1].tracked.motion_px / (self.views[-1].time - self.views[-2].time)

    def picture(self, view: View) -> Picture:
        """The image [H, W] of a view that tracks are followed in, uint8."""
        sharp = view.sharp
        grey = luminance(view.preview_rate(self._preview), self.sensor.mosaic) if sharp is None else sharp
        if self.sensor.response is Response.BERNOULLI:
            grey = smoothed(grey, float(np.median(view.deviation)))
        return picture(grey, white_of(grey))

    def _track_all(self, views: Iterable[View]) -> bool:
        """Track views; those of a long path have spaces between them."""
        dropped = False
        for view in views:
            if self.windows.spaced:
                self.odometry.skip()
            dropped |= self._track(view, skipped=self.windows.spaced)
            self.windows.spaced = self.odometry.long
        return dropped

    def _track(self, view: View, skipped: bool = False) -> bool:
        """Track a view and store it; with `skipped`, frames before it were left out."""
        image, intervals = self.picture(view), view.intervals if view.sharp is None else None
        known = None if self.given is None else self.given.at(view.time)
        tracked = self.odometry.add(view.time, view.end - view.begin, image, known, intervals, view.after_gap)
        since = np.inf if self._after_gap else view.time - self.views[-1].time
        self.views.add(view, tracked, bridged=skipped and since < BRIDGED_S * self.sensor.frame_rate_hz)
        self._after_gap = False
        if len(self.views) == 1:
            self.warnings += layout_warnings(self.sensor, view.rate)
        else:
            self.windows.follow(tracked.motion_px, view.time - self.views[-2].time)
        self.posed_views += tracked.rotation is not None
        return self.views.thin()


@dataclass(frozen=True)
class _Pictures:
    """Builds the images of keyframes anew from the recording."""

    of: ViewTracker

    def holds(self, view_id: int) -> bool:
        return self.of.views.rebuildable(view_id)

    def build(self, view_id: int) -> Picture | None:
        view = self.of.views.rebuilt(view_id)
        return None if view is None else self.of.picture(view)
