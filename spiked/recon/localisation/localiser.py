"""Where the camera of a recording was in a known map: searched for, followed, and searched for again."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spiked.calibration import Calibration
from spiked.errors import ConfigurationError, RecordingError
from spiked.pose import exp_so3, log_so3
from spiked.recon.blas import one_blas_thread
from spiked.recon.frontend.feature_tracks import LEVELS, Picture, Pyramid, Tracks, picture, pyramid, white_of
from spiked.recon.frontend.windowing import WINDOWS, View, Windows, luminance
from spiked.recon.localisation.alignment import NEAR_LEVELS, Anchor, Fit, align, correlation
from spiked.recon.localisation.map_index import MapIndex
from spiked.recon.localisation.recognition import LEAST_CORRELATION, LEAST_INLIERS, LEAST_SHARE, Recognition
from spiked.recon.localisation.search import search
from spiked.recon.odometry.sparse_map import Pose
from spiked.sensor import Sensor
from spiked.trajectory import Trajectory

MOTION_TRACKS = 100
"""Tracks that measure the motion, on which the length of the windows depends."""
SEARCH_EVERY_S = (0.001, 0.32)
"""Time from a start or a loss to the second search, which doubles from search to search, and the longest time."""
CONFIRM_S = 0.01
"""Least time from a search that found the path to the next: nearer views say much the same."""
DIM_SPIKES = 2.0
"""Spikes a pixel of a view, below which the next one is twice as long: windows do not follow a motion that has no
tracks. They are shortened again where the camera moves by more than a pixel in them."""
LEAST_VIEWS = 2
"""Views of a recording: searches in different views have to agree."""
ANCHOR_PX = 2.0
"""Image motion after which the map is rendered again."""


@dataclass(frozen=True)
class LocalisedView:
    """One view of a recording in the map."""

    time: float
    """Middle of the window in frames."""
    fit: Fit
    correlation: float
    """Of the newest render with the view that it was made for."""

    @property
    def pose(self) -> Pose:
        """Camera to world, in the map's frame of reference."""
        return self.fit.pose


@dataclass(frozen=True)
class Localisation:
    """Where the camera of a recording was in a map."""

    recognised: bool
    reason: str
    """Why it was or was not recognised, in one sentence."""
    views: list[LocalisedView]
    """In order of time; empty if the recording was not recognised."""
    searches: int
    """Views that were searched for in the whole map."""
    agreeing: int
    """Searches that found the pose that the path has there."""
    references: int
    """Reference views of the map."""
    best_inliers: int = 0
    """Most points of the map that agreed with one pose in a search."""

    def trajectory(self, frame_rate_hz: float) -> Trajectory:
        """The poses of the views, in the map's frame of reference."""
        times = np.array([view.time for view in self.views]) / frame_rate_hz
        rotations = np.array([view.pose.rotation for view in self.views]).reshape(-1, 3, 3)
        return Trajectory(times, rotations, np.array([view.pose.centre for view in self.views]).reshape(-1, 3))


class Localiser:
    """Feed frames with `feed`, and end with `finish`."""

    def __init__(self, index: MapIndex, sensor: Sensor, calibration: Calibration | None = None) -> None:
        """A localiser for recordings of `sensor`; its own intrinsics are not used but those of the index.

        Raises ConfigurationError for a sensor of another size than the camera of the index.
        """
        if (sensor.width, sensor.height) != (index.camera.width, index.camera.height):
            raise ConfigurationError(
                f"the recording is {sensor.width}x{sensor.height} and the index of the map is for a camera of "
                f"{index.camera.width}x{index.camera.height}: make the index for the camera of the recording"
            )
        self.index, self.sensor = index, sensor
        self._windows = Windows(sensor, None, calibration)
        self._tracks = Tracks(target=MOTION_TRACKS)
        self._recognition = Recognition(len(index))
        self._views: list[LocalisedView] = []
        self._seen = 0
        self._time = 0.0
        self._anchor: Anchor | None = None
        self._correlation = 0.0
        self._wait_s, self._next_search = 0.5 * SEARCH_EVERY_S[0], 0.0
        self._searched = -np.inf
        self._last: tuple[View, Picture] | None = None

    def feed(self, first_frame: int, frames: NDArray[np.uint8]) -> None:
        """Add stored frames uint8 [n, frame_bytes] that begin at absolute index `first_frame`."""
        with one_blas_thread():
            for view in self._windows.feed(first_frame, frames):
                self._add(view)

    def finish(self) -> Localisation:
        """The result. Raises RecordingError for a recording that is too short, too dark or without texture."""
        with one_blas_thread():
            for view in self._windows.flush():
                self._add(view)
            if self._last is not None and not self._recognition.decided:
                self._search(*self._last)
        if self._seen < LEAST_VIEWS:
            raise RecordingError(
                f"the recording is too short to be recognised: {self._seen} windows of frames, {LEAST_VIEWS} needed"
            )
        found = self._recognition
        found.check_texture()
        views = self._views if found.decided else []
        inliers = 0 if found.best is None else found.best.fit.inliers
        return Localisation(
            found.decided, found.reason(), views, found.searches, found.agreeing, len(self.index), inliers
        )

    def _add(self, view: View) -> None:
        grey = view.sharp
        if grey is None:
            rate = view.preview_rate(np.empty((self.sensor.height, self.sensor.width), np.float32))
            grey = luminance(rate, self.sensor.mosaic)
        image = picture(grey, white_of(grey))
        motion = self._tracks.add(self._seen, image, view.after_gap)
        if self._seen:
            self._windows.follow(motion, view.time - self._time)
        if view.spikes_a_pixel < DIM_SPIKES and not self._windows.sharpen:
            self._windows.length = min(2 * (view.end - view.begin), WINDOWS[-1])
        if view.after_gap:
            self._lose(view)
        self._seen, self._time, self._last = self._seen + 1, view.time, (view, image)
        levels = pyramid(image, LEVELS)
        followed = self._anchor is not None and self._follow(view, image, levels)
        if not followed:
            self._lose(view)
        if view.time >= self._next_search:
            self._search(view, image)

    def _lose(self, view: View) -> None:
        if self._anchor is not None:
            self._anchor, self._wait_s, self._next_search = None, 0.5 * SEARCH_EVERY_S[0], view.time

    def _follow(self, view: View, image: Picture, levels: Pyramid) -> bool:
        """The pose of a view near that of the one before; false if it is lost."""
        assert self._anchor is not None
        guess = self._predicted(view.time)
        fit = self._anchor.locate(levels, guess, NEAR_LEVELS)
        if fit is None or not _followed(fit):
            found = align(self.index.renderer, levels, guess, rounds=2)
        elif self._anchor.shift_px(fit.pose) > ANCHOR_PX:
            found = align(self.index.renderer, levels, fit.pose, rounds=1)
        else:
            self._keep(view, fit)
            return True
        if found is None or not _followed(found[0]):
            return False
        fit, self._anchor = found
        self._correlation = correlation(self._anchor.view, image)
        if self._correlation < LEAST_CORRELATION:
            return False
        self._keep(view, fit)
        return True

    def _predicted(self, time: float) -> Pose:
        """The pose at constant velocity."""
        last = self._views[-1]
        if len(self._views) < 2:
            return last.pose
        before = self._views[-2]
        share = (time - last.time) / (last.time - before.time)
        if not 0 < share < 4:
            return last.pose
        turn = log_so3(last.pose.rotation @ before.pose.rotation.T)
        return Pose(
            exp_so3(share * turn) @ last.pose.rotation,
            last.pose.centre + share * (last.pose.centre - before.pose.centre),
        )

    def _keep(self, view: View, fit: Fit) -> None:
        self._views.append(LocalisedView(view.time, fit, self._correlation))

    def _search(self, view: View, image: Picture) -> None:
        """Search for a view in the whole map: to find its pose, or to confirm the one that it has."""
        if view.time == self._searched:
            return
        self._searched = view.time
        found = search(self.index, image)
        pose = self._views[-1].pose if self._views and self._views[-1].time == view.time else None
        best = self._recognition.judge(found, pose)
        self._wait_s = min(max(2 * self._wait_s, CONFIRM_S if best is not None else 0.0), SEARCH_EVERY_S[1])
        if best is not None and pose is None:
            self._anchor, self._correlation = best.anchor, best.correlation
            self._keep(view, best.fit)
        self._next_search = view.time + self._wait_s * self.sensor.frame_rate_hz


def _followed(fit: Fit) -> bool:
    return fit.inliers >= LEAST_INLIERS and fit.share >= LEAST_SHARE
