"""From poses at the times of pictures to a pose for every frame."""

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from spiked.errors import ConfigurationError
from spiked.pose import Array
from spiked.trajectory import Trajectory

__all__ = ["interpolated"]

MOST_SPACINGS = 2.5
"""A gap of more than this many times the usual spacing of the pictures is not bridged: two pictures next to each
other may have failed, not three."""


def interpolated(times: Array, poses: tuple[Array, Array], *, frames: int, frame_rate_hz: float) -> Trajectory:
    """Poses at the middle of the frames of a recording, from poses at `times` [n] in frames.

    poses: camera-to-world rotations [n, 3, 3] and centres [n, 3]. Centres follow a cubic spline, rotations one with
    continuous angular acceleration. Frames before the first and after the last picture get a pose up to half a spacing
    away; wide gaps get none. Raises ConfigurationError for fewer than two poses.
    """
    if len(times) < 2:
        raise ConfigurationError(f"{len(times)} poses are too few to interpolate between; two are the least")
    rotations, centres = poses
    spacing = float(np.median(np.diff(times)))
    at = np.arange(frames) + 0.5
    after = np.searchsorted(times, at).clip(1, len(times) - 1)
    between = times[after] - times[after - 1] <= MOST_SPACINGS * spacing
    near = np.abs(at[:, None] - times).min(1) <= 0.5 * spacing
    inside = (at >= times[0]) & (at <= times[-1])
    at = at[near | (inside & between)]
    turned = _rotations(times, rotations, at)
    return Trajectory(at / frame_rate_hz, turned, np.asarray(CubicSpline(times, centres)(at), np.float64))


def _rotations(times: Array, rotations: Array, at: Array) -> Array:
    """The spline inside the given times, and beyond their ends its first and last turn continued at their rate."""
    spline = RotationSpline(times, Rotation.from_matrix(rotations))
    held = at.clip(times[0], times[-1])
    # The spline's rates are in camera axes.
    rest = Rotation.from_rotvec(spline(held, 1) * (at - held)[:, None])
    return np.asarray((spline(held) * rest).as_matrix(), np.float64)
