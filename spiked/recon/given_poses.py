"""Given camera poses: a reconstruction fits its map to them and does not change them."""

import numpy as np

from spiked.pose import Array
from spiked.recon.odometry.odometry import Odometry
from spiked.spline import Spline
from spiked.trajectory import Trajectory

KNOT_FRAMES = 8
"""Spacing of the knots of the final path."""
NEIGHBOUR_POSES = 2
"""Given poses before and after a time between which its pose is interpolated."""


class GivenPoses:
    """Poses of a trajectory at times in frames."""

    def __init__(self, poses: Trajectory, frame_rate_hz: float) -> None:
        self._poses = poses
        self._frames = poses.times_s * frame_rate_hz

    def at(self, time: float) -> tuple[Array, Array]:
        """Rotation [3, 3], camera to world, and centre [3] at a time in frames."""
        near = min(max(int(np.searchsorted(self._frames, time)), 1), len(self._frames) - 1)
        around = slice(max(0, near - NEIGHBOUR_POSES), near + NEIGHBOUR_POSES)
        rotations, centres = self._poses.rotations[around], self._poses.centres[around]
        rotation, centre = Spline.fit(self._frames[around], rotations, centres, 1e9, degree=1).poses([time])
        return rotation[0], centre[0]

    def end(self, odometry: Odometry, frames: int) -> float:
        """Make these poses the path of the odometry, in units of the median depth.

        `frames` is the length of the recording. Returns the median depth in the unit of the given poses, 1 where no
        depth is known.
        """
        span = (0.0, float(frames))
        spline = Spline.fit(self._frames, self._poses.rotations, self._poses.centres, KNOT_FRAMES, span=span)
        return odometry.end_with_path(spline, 0.5 * frames) or 1.0
