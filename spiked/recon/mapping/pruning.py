"""Pruning: splats that no view needs, and those in front of the cameras where nothing is."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spiked.pose import Array
from spiked.render import AnyRasteriser
from spiked.scene import Scene

SPAN_PERCENTILES = 1, 99
"""Percentiles of the means along each axis that give the size of a scene."""

AHEAD_COS = 0.5
"""Cosine of the largest angle from the optical axis at which a splat lies ahead: its image says how near it may be."""


@dataclass(frozen=True)
class Pruning:
    """Which splats are removed in a refinement, and how large they may be."""

    at: tuple[float, ...] = (0.35, 0.7)
    """Shares of the refinement after which splats are removed."""
    views: int = 160
    """Most views in which splats are looked for, spread over the path."""
    least_px: float = 0.3
    """Pixels that a splat has to fill, all that hide it counted, in the view where it fills most."""
    nearest: float = 0.5
    """Least distance of a splat from a camera, over that of the nearest points in its view."""
    near_percentile: float = 1.0
    """Percentile of the depths of a view's points that counts as the nearest."""
    span_share: float = 1 / 12
    """Largest standard deviation of a splat over the size of the scene: three of them are a quarter of it."""
    widest: float = 0.05
    """Largest standard deviation of a splat over its distance from a camera with distortion, radians: the picture of a
    wider one is not that of its Jacobian, and a camera without distortion shows it elsewhere (decision 23)."""
    widths_every: int = 20
    """Steps between those that limit it, each by the camera of its view."""

    def due(self, share: float) -> int:
        """Number of prunings that should have been made at that share of the refinement."""
        return sum(share >= at for at in self.at)

    def largest(self, scene: Scene) -> float:
        """Largest standard deviation of a splat, in the scene's unit."""
        low, high = np.percentile(scene.means, SPAN_PERCENTILES, axis=0)
        return self.span_share * float(np.linalg.norm(high - low))

    def needless(
        self, scene: Scene, rasteriser: AnyRasteriser, poses: Iterable[tuple[Array, Array, float]], pixel: int
    ) -> NDArray[np.bool_]:
        """Splats [N] to be removed, by views: rotation, centre and depth of the nearest points.

        `pixel` is the size of the rasteriser's pixels, in sensor pixels.
        """
        filled, near = np.zeros(len(scene), np.float32), np.zeros(len(scene), bool)
        for rotation, centre, depth in poses:
            image = rasteriser.forward(scene, rotation[None], centre[None])
            # Each colour enters the image with the weight of its splat.
            weights = rasteriser.backward(np.ones_like(image.values)).colours
            np.maximum(filled, weights.reshape(len(scene), -1).mean(1), out=filled)
            offset = scene.means - centre.astype(np.float32)
            distance = np.sqrt(np.einsum("nd,nd->n", offset, offset))
            ahead = offset @ rotation[:, 2].astype(np.float32) > AHEAD_COS * distance
            near |= ahead & (distance < self.nearest * depth)
        return np.asarray(near | (filled * pixel**2 < self.least_px))
