"""The scale of a scene from two cameras at a known distance of each other, with both paths in the scene."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spiked.errors import ConfigurationError, SceneError
from spiked.trajectory import Trajectory

__all__ = ["BaselineScale", "scale_by_baseline"]

LEAST_POSES = 4
"""Poses of the first path that the second one has to overlap in time."""
MOST_SCATTER = 0.2
"""Scatter of the distance over the distance from which the cameras are not on one rig."""


@dataclass(frozen=True)
class BaselineScale:
    """The scale by a baseline."""

    metres_per_unit: float
    sigma: float
    """Relative scatter of the distance along the path: neighbouring poses share their errors, so it is not divided."""
    poses: int
    """Moments at which both cameras have a pose."""


def scale_by_baseline(first: Trajectory, second: Trajectory, baseline_m: float, offset_s: float = 0.0) -> BaselineScale:
    """The scale by the distance of two cameras on a rig; the second path begins `offset_s` after the first.

    Raises ConfigurationError for a distance that is not positive, SceneError if the paths have too few moments in
    common or the distance is not constant.
    """
    if not baseline_m > 0:
        raise ConfigurationError(f"a baseline of {baseline_m:g} m: the distance has to be positive")
    times = first.times_s - offset_s
    common = np.zeros(len(times), bool)
    if len(second):
        common = (times >= second.times_s[0]) & (times <= second.times_s[-1])
    if common.sum() < LEAST_POSES:
        raise SceneError(
            f"both cameras have a pose at {common.sum()} moments only: state the offset, by which the second recording "
            "began later (`spiked offset`)"
        )
    distances = np.linalg.norm(first.centres[common] - _at(second, times[common]), axis=1)
    middle = float(np.median(distances))
    scatter = float(1.4826 * np.median(np.abs(distances - middle))) / max(middle, 1e-300)
    if not scatter < MOST_SCATTER:
        raise SceneError(
            f"the distance of the cameras varies by {scatter:.0%}: they are not on one rig, or the offset is wrong"
        )
    return BaselineScale(baseline_m / middle, max(scatter, 1e-6), int(common.sum()))


def _at(path: Trajectory, times_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Positions [n, 3] between the poses."""
    return np.stack([np.interp(times_s, path.times_s, path.centres[:, axis]) for axis in range(3)], axis=1)
