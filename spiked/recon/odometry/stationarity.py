"""Detects a stationary camera in a recording without a path, with or without a moving object."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from spiked.pose import Array
from spiked.recon.statistics import median

STOOD_PX = 0.3
"""Median displacement from the first positions below which the camera stood still."""
STILL_PX = 0.12
"""Image motion between two views that counts as none: below the accuracy of tracks."""
MOVED_PX = 2.0
"""Displacement above which a point moves, whatever the noise of its track."""
LEAST_TRACKS = 30
"""Earlier tracks that a view needs for the decision."""
LEAST_VIEWS = 3
"""Views that the decision needs."""
OBJECT_SHARE, OBJECT_TRACKS = 0.02, 8
"""Share of the observations and number of points that distinguish an object from wrong tracks."""


def moving_object_share(views: Sequence[tuple[NDArray[np.int64], Array]]) -> float | None:
    """Share of the observations that move in front of a stationary camera; 0 if none does.

    None if the camera moved or there are too few tracks. A view is the ids [n] of its tracks and their positions
    [n, 2] px.
    """
    if len(views) < LEAST_VIEWS:
        return None
    count = 1 + max((int(ids.max()) for ids, _ in views if len(ids)), default=0)
    first, farthest, seen = np.full((count, 2), np.nan), np.zeros(count), np.zeros(count, int)
    for number, (ids, at) in enumerate(views):
        new = np.isnan(first[ids, 0])
        first[ids[new]] = at[new]
        moved = np.linalg.norm(at - first[ids], axis=1)
        farthest[ids] = np.maximum(farthest[ids], moved)
        seen[ids] += 1
        if number and (np.count_nonzero(~new) < LEAST_TRACKS or median(moved[~new]) >= STOOD_PX):
            return None
    moves = farthest > MOVED_PX
    share = float(seen[moves].sum() / seen.sum())
    return share if share >= OBJECT_SHARE and np.count_nonzero(moves) >= OBJECT_TRACKS else 0.0
