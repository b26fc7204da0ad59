"""Seeding: splats at the pixels of views whose depth was swept."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spiked.pose import Array
from spiked.recon.frontend.windowing import View
from spiked.recon.mapping.plane_sweep import Sweep
from spiked.scene import Scene
from spiked.sensor import Image, Intrinsics

LEAST_POINTS = 10
"""Points in front of a view that its range of depths needs."""
LEAST_PIXELS = 20
"""Fewer uncovered pixels of a view are not seeded."""
DEPTH_PERCENTILES = (1, 99.5)
"""Percentiles of the points' inverse depths that bound the sweep; the nearest points matter more than the farthest."""
SEED_LOGIT = 0.5
"""Opacity logit of a new splat, an opacity of 0.62."""


@dataclass(frozen=True)
class SweptView:
    """A view with its pose, camera to world, and its swept depth."""

    view: View
    rotation: Array
    centre: Array
    depth: float
    """Median depth of the points in view."""
    sweep: Sweep


@dataclass(frozen=True)
class Seeding:
    """Where depth is swept and which pixels become splats."""

    views: int = 11
    """Views swept at the start of a refinement (decision 8)."""
    nearest: float = 1.3
    """Inverse depth of the nearest plane over the upper one of `DEPTH_PERCENTILES`."""
    farthest: float = 0.5
    """Inverse depth of the farthest plane over the lower one."""
    noise: float = 1.5
    """Standard deviation of the difference of two views over that of one: about sqrt(2) for independent noise."""
    sure: float = 0.6
    """Depth confidence of the pixels seeded first; the others are seeded where no view is more confident (decision
    8)."""
    share: float = 0.3
    """Largest share of the cap that one view seeds: the first leaves some for others, and covers all of its image
    (decision 8)."""
    opacity: float = 0.5
    """Pixels that the map covers with less are seeded."""
    size: float = 0.6
    """Standard deviation of a splat over the distance between splats."""

    live_views: int = 12
    """A live map of more views is seeded again as the path grows."""
    live_share: float = 0.3
    """Share of the path, in time, that has to be new since the last seeding of a live map."""
    live_px: float = 60.0
    """Image motion from one seeding of a live map to the next where views are far apart."""

    def due(self, times: Sequence[float], seeded_at: float) -> bool:
        """Whether to seed a live map again, with views at `times` and the last seeding in the view at `seeded_at`."""
        return len(times) > self.live_views and times[-1] - seeded_at > self.live_share * (times[-1] - times[0])

    def order(self, ids: Sequence[int], extent: float = 1.0) -> list[int]:
        """The views to sweep at the start of a refinement: spread evenly, those in the middle first.

        Their number grows with the `extent` of the map, see `MapOptions.extent_px`.
        """
        count = self.views if extent == 1 else min(round(self.views * extent), len(ids))
        rows = np.linspace(0, len(ids) - 1, count).round().astype(int)
        return [ids[i] for i in rows[np.argsort(np.abs(rows - rows.mean()))]]

    def planes(self, depths: Array) -> tuple[float, float] | None:
        """Inverse depths of the nearest and the farthest plane for points at these depths; None for too few points."""
        ahead = depths[depths > 0]
        if len(ahead) < LEAST_POINTS:
            return None
        low, high = np.percentile(1 / ahead, DEPTH_PERCENTILES)
        return self.nearest * high, self.farthest * low

    def stride(self, pixels: int, cap: int, least_px: float) -> float:
        """Distance in px between the pixels of an image that become splats."""
        return max(least_px, float(np.sqrt(pixels / (self.share * cap))))

    def pixels(
        self, empty: NDArray[np.bool_], stride: float, limit: int
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]] | None:
        """Rows and columns of at most `limit` pixels, `stride` apart, that are `empty` [H, W]; None for too few."""
        height, width = empty.shape
        v, u = (
            g.ravel().astype(int)
            for g in np.meshgrid(
                np.arange(stride / 2, height, stride), np.arange(stride / 2, width, stride), indexing="ij"
            )
        )
        keep = empty[v, u]
        u, v = u[keep][:limit], v[keep][:limit]
        return None if len(u) < LEAST_PIXELS else (v, u)


def isotropic_splats(
    intrinsics: Intrinsics,
    pixels: Array,
    depth: Image,
    colours: Image,
    deviation_px: float,
    rotation: Array,
    centre: Array,
) -> Scene:
    """Round splats at `pixels` [N, 2] of a camera and `depth` [N], `deviation_px` wide in the image.

    The pose is camera to world; colours are [N, C].
    """
    count = len(pixels)
    log_scale = np.log(deviation_px * depth / intrinsics.focal_at(pixels))
    quats = np.zeros((count, 4), np.float32)
    quats[:, 0] = 1
    return Scene(
        np.ascontiguousarray((intrinsics.unproject(pixels) * depth[:, None]) @ rotation.T + centre, np.float32),
        quats,
        np.repeat(log_scale[:, None], 3, 1).astype(np.float32),
        np.full(count, SEED_LOGIT, np.float32),
        np.ascontiguousarray(colours, np.float32),
    )
