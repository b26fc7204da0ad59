"""Paths of the camera of a video: as recorded, smoothed, or through a few poses."""

from dataclasses import dataclass

import numpy as np

from spiked.errors import SceneError
from spiked.pose import Array
from spiked.recon.statistics import evenly
from spiked.spline import Path, Spline, Waypoints
from spiked.trajectory import Trajectory

__all__ = ["CameraPath", "calm_path", "recorded_path", "smoothed_path", "waypoint_path"]

SPANS_A_SECOND = 4.0
"""Of the spline of a smoothed path: a hand turns within a quarter of a second, and trembles at 8 to 12 Hz."""
LEAST_SPANS, MOST_SPANS = 4, 400
"""Fewest and most spans of a smoothed path."""

LEAST_SMOOTHED = 4
"""Poses that a path needs to be smoothed."""
MOST_FITTED = 2000
"""Poses that a smoothed path is fitted to, at most, evenly chosen."""
MOST_WAYPOINTS = 500
"""Poses of a path through poses, at most: its fit is dense."""


@dataclass(frozen=True)
class CameraPath:
    """Poses over the whole length of a video, camera to world."""

    poses: Path
    end: float
    """Its last time; the first is 0."""

    def sampled(self, pictures: int) -> tuple[Array, Array]:
        """Rotations [n, 3, 3] and centres [n, 3] of n pictures, evenly spaced from its beginning to its end."""
        return self.poses.poses(np.linspace(0, self.end, pictures))


def recorded_path(recorded: Trajectory) -> CameraPath:
    """As the camera went, at its own pace. Raises SceneError without poses."""
    _need(recorded, 1)
    times = recorded.times_s - recorded.times_s[0]
    return CameraPath(Waypoints(times, recorded.rotations, recorded.centres), float(times[-1]))


def calm_path(recorded: Trajectory) -> CameraPath:
    """Smoothed, or as recorded if that has too few poses. Raises SceneError without poses."""
    return smoothed_path(recorded) if len(recorded) >= LEAST_SMOOTHED else recorded_path(recorded)


def smoothed_path(recorded: Trajectory) -> CameraPath:
    """The nearest cubic spline of `SPANS_A_SECOND`: without what is faster, such as tremor.

    Raises SceneError with fewer than four poses, or without a time between them.
    """
    _need(recorded, LEAST_SMOOTHED)
    times = recorded.times_s - recorded.times_s[0]
    if times[-1] <= 0:
        raise SceneError("a path whose poses are all of one time cannot be smoothed")
    some = evenly(len(recorded), MOST_FITTED)
    spans = min(np.clip(round(SPANS_A_SECOND * times[-1]), LEAST_SPANS, MOST_SPANS), len(some) - 3)
    ticks = times[some] * (spans / times[-1])
    return CameraPath(Spline.fit(ticks, recorded.rotations[some], recorded.centres[some], 1.0), float(ticks[-1]))


def waypoint_path(poses: Trajectory) -> CameraPath:
    """Smoothly through poses, such as bookmarks, as long from each to the next; their times only give the order.

    A cubic spline. Raises SceneError with fewer than two poses, or more than `MOST_WAYPOINTS`.
    """
    _need(poses, 2)
    if len(poses) > MOST_WAYPOINTS:
        raise SceneError(f"{len(poses):,} poses are too many to pass through, at most {MOST_WAYPOINTS}: choose some")
    return CameraPath(Spline.fit(np.arange(len(poses)), poses.rotations, poses.centres, 1.0), len(poses) - 1.0)


def _need(path: Trajectory, poses: int) -> None:
    if len(path) < poses:
        raise SceneError(f"the path has {len(path)} poses, and a video needs {poses} or more")
