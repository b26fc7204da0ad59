"""Moves tracks to the time of their view: each pixel's charge is centred on a time of its own.

The difference is usually a fraction of a frame. At the ends of recordings and gaps, intervals are missing on one side
and all tracks are early or late: without correction the path is biased in time there.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spiked.pose import Array
from spiked.recon.statistics import median

VELOCITY_ERROR_SHARE = 0.25
"""Relative standard deviation of the shift: the pixels around a track have different times."""
NEIGHBOURS = 8
"""Neighbouring tracks whose median velocity a new track takes."""


@dataclass(frozen=True)
class _TimedView:
    """The tracks of one view."""

    time: float
    ids: NDArray[np.int64]
    at: Array
    times: Array
    velocity: Array


@dataclass
class TrackTimestamps:
    """Aligns tracks with the times of their views; keeps the previous view."""

    last: _TimedView | None = None

    def align(self, time: float, ids: NDArray[np.int64], at: Array, late: Array) -> tuple[Array, float]:
        """Positions [n, 2] at `time` of tracks `ids` [n] seen at `at` [n, 2] `late` [n] frames after it, and the
        standard deviation in px that this adds to their noise."""
        velocity = np.zeros_like(at) if self.last is None else _velocity(self.last, time, ids, at, time + late)
        self.last = _TimedView(time, ids.copy(), at.copy(), time + late, velocity)
        shift = velocity * late[:, None]
        sigma_px = VELOCITY_ERROR_SHARE * median(np.linalg.norm(shift, axis=1)) if len(ids) else 0.0
        return np.asarray(at - shift), sigma_px


def _velocity(last: _TimedView, time: float, ids: NDArray[np.int64], at: Array, times: Array) -> Array:
    """Velocity of each track in px a frame: the previous one if both views have nearly the same times, that of the
    neighbours for new tracks."""
    velocity = np.zeros_like(at)
    order = np.argsort(last.ids)
    place = np.minimum(np.searchsorted(last.ids, ids, sorter=order), max(len(order) - 1, 0))
    kept = last.ids[order[place]] == ids if len(order) else np.zeros(len(ids), bool)
    new, old = np.flatnonzero(kept), order[place[kept]] if len(order) else order
    if len(new) < NEIGHBOURS:
        return velocity
    apart = times[new] - last.times[old]
    weight = np.clip(2 * apart / (time - last.time) - 1, 0, 1)[:, None]
    moved = (at[new] - last.at[old]) / np.maximum(apart, 0.5)[:, None]
    velocity[new] = weight * moved + (1 - weight) * last.velocity[old]
    rest = np.flatnonzero(~kept)
    if len(rest) == 0:
        return velocity
    distance = ((at[rest, None] - at[None, new]) ** 2).sum(2)
    near = np.argpartition(distance, NEIGHBOURS - 1, axis=1)[:, :NEIGHBOURS]
    velocity[rest] = np.median(velocity[new][near], axis=1)
    return velocity
