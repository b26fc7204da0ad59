"""Initialisation of a scene with a moving object.

An object that crosses the image evenly can be explained as a near point: its tracks then fit and bend the path, because
near points constrain the camera most. Initialisation is repeated without the tracks of distinct motion, and that result
is taken if the residuals of the others fall clearly.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from spiked.recon.odometry.initialisation import (
    FULL_PARALLAX,
    Hypothesis,
    InitialisationResult,
    LeastParallax,
    Views,
    bootstrap,
    converge_without,
)

MOVING_SHARE = (0.04, 0.45)
"""Share of the tracks that may be left out: fewer have no effect, more may be the scene."""
NEAR_RATIO = 3.0
"""Inverse depth over the median one above which a point is probably an object explained as a near point."""
UNCHANGED_RATIO = (0.9, 1.1)
"""Ratio of the others' residuals without and with the tracks that counts as unchanged: no second initialisation.
Without a moving object it stays within 8 % (decision 10)."""
IMPROVED_RATIO = 0.85
"""Ratio below which the tracks are left out (decision 10)."""
CLUSTERING_ROUNDS = 20
"""Most iterations of the 2-means clustering."""


def initialise(views: Views, seed: int = 0, least: LeastParallax = FULL_PARALLAX) -> InitialisationResult:
    """As `bootstrap`, without the tracks of distinct motion if they contradict the others."""
    result = bootstrap(views, seed, least)
    if not result.tried:
        return result
    apart = moving_apart(views)
    if not MOVING_SHARE[0] < apart.mean() < MOVING_SHARE[1]:
        return result
    best = result.winner or min(result.tried, key=lambda one: one.cost)
    before = _agreement(best)[~apart]
    near = best.bundle.points[:, 2] < np.median(best.bundle.points[:, 2]) / NEAR_RATIO
    if not MOVING_SHARE[0] < near.mean() < MOVING_SHARE[1]:
        refitted = converge_without(best, apart)
        if UNCHANGED_RATIO[0] < np.median(_agreement(refitted)) / np.median(before) < UNCHANGED_RATIO[1]:
            return result
    rest = replace(views, pixels=views.pixels[:, ~apart], ids=views.ids[~apart])
    other = bootstrap(rest, seed, least)
    if other.winner is None or np.median(_agreement(other.winner)) > IMPROVED_RATIO * np.median(before):
        return result
    return other


def moving_apart(views: Views) -> NDArray[np.bool_]:
    """Mask [P] of the smaller of two clusters of the tracks' motions (2-means)."""
    motion = (views.pixels[1:] - views.pixels[0]).transpose(1, 0, 2).reshape(len(views.ids), -1)
    middle = motion - motion.mean(0)
    along = middle @ np.linalg.svd(middle, full_matrices=False)[2][0]
    group = along > 0.5 * (along.min() + along.max())
    for _ in range(CLUSTERING_ROUNDS):
        if group.all() or not group.any():
            break
        distance = [((motion - motion[side].mean(0)) ** 2).sum(1) for side in (group, ~group)]
        nearer = distance[0] < distance[1]
        if (nearer == group).all():
            break
        group = nearer
    return np.asarray(group if group.mean() < 0.5 else ~group)


def _agreement(one: Hypothesis) -> NDArray[np.float64]:
    """Median residual of each track [P] in px."""
    error = np.linalg.norm(one.bundle.residuals(), axis=1).reshape(-1, len(one.bundle.points))
    return np.asarray(np.median(error, 0))
