"""When each track was where it was seen: a pixel's charge comes together around a time of its own, not the view's.

Mostly that differs by a fraction of a frame, but at the ends of a recording and of a gap whole intervals are missing on
one side, and all tracks are seen early or late: there the path would lag behind or run ahead.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spiked.pose import Array
from spiked.recon.robust import median

UNSURE = 0.25
"""Part of a shift to the view's time that may be wrong: the pixels around a track looked at different times."""
NEAR = 8
"""Tracks whose motion is taken for that of one without a past."""


@dataclass(frozen=True)
class _Seen:
    """The tracks of one view."""

    time: float
    ids: NDArray[np.int64]
    at: Array
    times: Array
    velocity: Array


@dataclass
class Stamps:
    """Brings tracks to the times of their views; remembers the view before."""

    last: _Seen | None = None

    def level(self, time: float, ids: NDArray[np.int64], at: Array, late: Array) -> tuple[Array, float]:
        """Where tracks `ids` [n], seen at `at` [n, 2] `late` [n] frames after `time`, were at `time`: [n, 2]; and the
        standard deviation of what that adds to their noise."""
        velocity = np.zeros_like(at) if self.last is None else _velocity(self.last, time, ids, at, time + late)
        self.last = _Seen(time, ids.copy(), at.copy(), time + late, velocity)
        shift = velocity * late[:, None]
        unsure = UNSURE * median(np.linalg.norm(shift, axis=1)) if len(ids) else 0.0
        return np.asarray(at - shift), unsure


def _velocity(last: _Seen, time: float, ids: NDArray[np.int64], at: Array, times: Array) -> Array:
    """Motion of each track in px a frame. Where two views looked at nearly the same moments it is the one from before,
    and new tracks move as those around them."""
    velocity = np.zeros_like(at)
    order = np.argsort(last.ids)
    place = np.minimum(np.searchsorted(last.ids, ids, sorter=order), max(len(order) - 1, 0))
    kept = last.ids[order[place]] == ids if len(order) else np.zeros(len(ids), bool)
    new, old = np.flatnonzero(kept), order[place[kept]] if len(order) else order
    if len(new) < NEAR:
        return velocity
    apart = times[new] - last.times[old]
    sure = np.clip(2 * apart / (time - last.time) - 1, 0, 1)[:, None]
    moved = (at[new] - last.at[old]) / np.maximum(apart, 0.5)[:, None]
    velocity[new] = sure * moved + (1 - sure) * last.velocity[old]
    rest = np.flatnonzero(~kept)
    if len(rest) == 0:
        return velocity
    distance = ((at[rest, None] - at[None, new]) ** 2).sum(2)
    near = np.argpartition(distance, NEAR - 1, axis=1)[:, :NEAR]
    velocity[rest] = np.median(velocity[new][near], axis=1)
    return velocity
