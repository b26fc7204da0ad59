"""The first map of a scene in which something moves by itself.

A thing that crosses the image evenly can be taken for one that is near: its tracks then fit, and bend the path, because
near points say most about where a camera is. So the tracks that move apart from the others are left out once, and if
the others then agree much better among themselves they were what bent it.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from spiked.recon.bootstrap import MIN_PARALLAX_PX, Hypothesis, Verdict, Views, bootstrap, converge_without

SHARE = (0.04, 0.45)
"""Part of the tracks that may be left out: fewer bend nothing, and more may be the scene."""
NEAR = 3.0
"""Inverse depth, in medians, of what is suspiciously near."""
SUSPICIOUS = (0.9, 1.1)
"""Residual of the others without them over that with them, from where on to look closer: above, the old path leads
nowhere else."""
CLEARLY = 0.85
"""And below which they are left out."""
ROUNDS = 20


def first_map(views: Views, seed: int = 0, min_parallax_px: float = MIN_PARALLAX_PX) -> Verdict:
    """As `bootstrap`, but without the tracks that move apart where those contradict the others."""
    verdict = bootstrap(views, seed, min_parallax_px)
    if not verdict.tried:
        return verdict
    apart = moving_apart(views)
    if not SHARE[0] < apart.mean() < SHARE[1]:
        return verdict
    best = verdict.winner or min(verdict.tried, key=lambda one: one.cost)
    before = _agreement(best)[~apart]
    near = best.bundle.points[:, 2] < np.median(best.bundle.points[:, 2]) / NEAR
    if not SHARE[0] < near.mean() < SHARE[1]:
        quick = converge_without(best, apart)
        if SUSPICIOUS[0] < np.median(_agreement(quick)) / np.median(before) < SUSPICIOUS[1]:
            return verdict
    rest = replace(views, pixels=views.pixels[:, ~apart], ids=views.ids[~apart])
    other = bootstrap(rest, seed, min_parallax_px)
    if other.winner is None or np.median(_agreement(other.winner)) > CLEARLY * np.median(before):
        return verdict
    return other


def moving_apart(views: Views) -> NDArray[np.bool_]:
    """The smaller of the two groups [P] that the motions of the tracks fall into (two means)."""
    motion = (views.pixels[1:] - views.pixels[0]).transpose(1, 0, 2).reshape(len(views.ids), -1)
    middle = motion - motion.mean(0)
    along = middle @ np.linalg.svd(middle, full_matrices=False)[2][0]
    group = along > 0.5 * (along.min() + along.max())
    for _ in range(ROUNDS):
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
