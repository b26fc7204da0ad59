"""Which views of a long path the map is fitted to: those that add something."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from spiked.pose import Array
from spiked.recon.odometry.sparse_map import TrackedView
from spiked.recon.statistics import evenly

CELL_PX = 32.0
"""Side of a cell of the surface in the image, at the distance of a power of two just below that of the camera."""
DIRECTION = 0.1
"""Side of the cells of viewing directions: an angle of about 6 degrees."""
LEAST_NEW = 0.05
"""Share of the cells of a view that have to be new."""
BLUR_PX = 1.0
"""Image motion in views that counts as equally sharp."""
MOST_VIEWS_OF_A_CELL = 32
"""Most views of one cell, see `choose`: more of them only lower its noise."""


def choose(views: Sequence[TrackedView], points: Array, focal_px: float, most: int) -> list[int]:
    """Ids of at most `most` of these views, all with a pose, that show surface that the others do not.

    The surface is that of the known points, `points` [tracks, 3] by id, NaN where unknown. A part of it counts anew for
    each viewing direction and, in octaves, distance. A view is chosen if `LEAST_NEW` of what it sees was seen by fewer
    than n of those chosen before it; n is the largest power of two, up to `MOST_VIEWS_OF_A_CELL`, for which they are
    not too many. A camera that stands still adds at most n views. Views of little motion come before blurred ones.
    """
    if not views:
        return []
    views = sorted(views, key=lambda view: (round(view.motion_px / BLUR_PX), view.id))
    cells = _cells(views, points, focal_px)
    chosen: list[int] = []
    each = 1
    while each <= MOST_VIEWS_OF_A_CELL:
        more = _seen_by_fewer(cells, each)
        if len(more) > most:
            break
        chosen, each = more, 2 * each
    if not chosen:  # too many even with one view of each cell
        more = _seen_by_fewer(cells, 1)
        chosen = [more[i] for i in evenly(len(more), most)]
    return sorted(views[row].id for row in chosen)


def _seen_by_fewer(cells: list[NDArray[np.int64]], each: int) -> list[int]:
    """Rows of the views of which `LEAST_NEW` of the cells were seen by fewer than `each` of the rows before."""
    seen = np.zeros(1 + max((int(own.max(initial=0)) for own in cells), default=0), np.int64)
    rows = []
    for row, own in enumerate(cells):
        if len(own) and (seen[own] < each).mean() >= LEAST_NEW:
            seen[own] += 1
            rows.append(row)
    return rows


def _cells(views: Sequence[TrackedView], points: Array, focal_px: float) -> list[NDArray[np.int64]]:
    """Numbers of the cells that each view sees."""
    keys = [_keys(view, points, focal_px) for view in views]
    _, number = np.unique(np.concatenate(keys), axis=0, return_inverse=True)
    parts = np.split(number.ravel(), np.cumsum([len(own) for own in keys])[:-1])
    return [np.unique(part) for part in parts]


def _keys(view: TrackedView, points: Array, focal_px: float) -> NDArray[np.int32]:
    """[n, 7]: octave of the distance, place and direction of the known points in a view."""
    assert view.centre is not None
    seen = points[view.ids]
    seen = seen[np.isfinite(seen[:, 0])]
    ray = view.centre - seen
    distance = np.maximum(np.linalg.norm(ray, axis=1), 1e-9)
    octave = np.floor(np.log2(distance))
    side = CELL_PX / focal_px * 2**octave
    place = np.floor(seen / side[:, None])
    direction = np.floor(ray / distance[:, None] / DIRECTION)
    return np.column_stack([octave, place, direction]).astype(np.int32)
