"""Given camera poses: a reconstruction fits its map to them and does not change them."""

import numpy as np

from spiked.errors import ConfigurationError
from spiked.pose import Array
from spiked.spline import Spline
from spiked.trajectory import Trajectory

KNOT_FRAMES = 8
"""Spacing of the knots of the final path."""
LEAST_POSES = 2
"""Poses between which others are interpolated."""
NEIGHBOUR_POSES = 2
"""Given poses before and after a time between which its pose is interpolated."""


class GivenPoses:
    """Poses of a trajectory at times in frames."""

    def __init__(self, poses: Trajectory, frame_rate_hz: float) -> None:
        """Raises ConfigurationError for poses that are no path."""
        if len(poses) < LEAST_POSES:
            raise ConfigurationError(f"the given poses are {len(poses)}: at least {LEAST_POSES} are needed")
        self._poses = poses
        self._frames = poses.times_s * frame_rate_hz
        twice = np.flatnonzero(np.diff(self._frames) <= 0)
        if len(twice):
            raise ConfigurationError(f"two of the given poses are of the time {poses.times_s[twice[0]]} s: remove one")

    def check(self, frames: int) -> None:
        """Raises ConfigurationError if no pose is of the time of a recording of so many frames."""
        first_s, last_s = (float(self._poses.times_s[row]) for row in (0, -1))
        if self._frames[0] > frames or self._frames[-1] < 0:
            raise ConfigurationError(
                f"the given poses are from {first_s:g} to {last_s:g} s, and the recording has {frames} frames from 0 s "
                "on: give times in seconds since its first frame"
            )

    def at(self, time: float) -> tuple[Array, Array]:
        """Rotation [3, 3], camera to world, and centre [3] at a time in frames."""
        near = min(max(int(np.searchsorted(self._frames, time)), 1), len(self._frames) - 1)
        around = slice(max(0, near - NEIGHBOUR_POSES), near + NEIGHBOUR_POSES)
        rotations, centres = self._poses.rotations[around], self._poses.centres[around]
        rotation, centre = Spline.fit(self._frames[around], rotations, centres, 1e9, degree=1).poses([time])
        return rotation[0], centre[0]

    def path(self, frames: int) -> Spline:
        """Through these poses, over a recording of so many frames. Raises ConfigurationError, see `check`."""
        self.check(frames)
        # Poses before and after the recording count as far as the path at its begin and end lies between them.
        ends = [self.at(time) for time in (0.0, float(frames))]
        inside = (self._frames > 0) & (self._frames < frames)
        times = np.concatenate([[0.0], self._frames[inside], [float(frames)]])
        rotations, centres = (
            np.concatenate([[ends[0][k]], given[inside], [ends[1][k]]])
            for k, given in enumerate((self._poses.rotations, self._poses.centres))
        )
        return Spline.fit(times, rotations, centres, KNOT_FRAMES)
