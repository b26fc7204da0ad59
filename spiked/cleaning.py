"""Cleaning of a scene: what lies outside a box or inside an outline, floaters, which few views see or which hang alone,
and splats that are too large."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from spiked.errors import ConfigurationError
from spiked.recon.statistics import evenly
from spiked.render import Camera, rasteriser_for
from spiked.scene import Scene
from spiked.splitting import split_large
from spiked.trajectory import Trajectory

__all__ = ["Box", "Cleaned", "FloaterRemoval", "Outline", "clean"]

Mask = NDArray[np.bool_]

SEEN = 0.25
"""Share of the work that is counting the views of each splat, where large ones are split."""


@dataclass(frozen=True)
class Box:
    """A box along the axes of a scene."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    def __post_init__(self) -> None:
        if not all(a < b for a, b in zip(self.low, self.high, strict=True)):
            raise ConfigurationError(
                f"the box from {self.low} to {self.high} is empty: each low side is below its high"
            )

    def contains(self, scene: Scene) -> Mask:
        """Splats [N] whose means are inside."""
        low, high = np.array(self.low, np.float32), np.array(self.high, np.float32)
        return np.asarray(((scene.means >= low) & (scene.means <= high)).all(axis=1))


@dataclass(frozen=True, eq=False)
class Outline:
    """A closed outline as a camera sees it, and all that lies behind it."""

    corners: NDArray[np.float64]
    """Slopes x/z and y/z in the camera's axes, [k >= 3, 2]; the last one is joined to the first."""
    rotation: NDArray[np.float64]
    """Camera to world, OpenCV axes, [3, 3]."""
    centre: NDArray[np.float64]
    """Of the camera, [3]."""

    def __post_init__(self) -> None:
        if self.corners.ndim != 2 or self.corners.shape[1] != 2 or len(self.corners) < 3:
            raise ConfigurationError(f"an outline has three corners or more, not {len(self.corners)}")
        if not np.isfinite(self.corners).all():
            raise ConfigurationError("an outline has corners that are not finite")

    def contains(self, scene: Scene) -> Mask:
        """Splats [N] in front of the camera whose means are inside; where it crosses itself, by the even-odd rule."""
        seen = (scene.means - self.centre) @ self.rotation
        ahead = seen[:, 2] > 0
        x, y = (seen[:, k] / np.where(ahead, seen[:, 2], 1) for k in (0, 1))
        inside = np.zeros(len(scene), bool)
        for (x0, y0), (x1, y1) in zip(self.corners, np.roll(self.corners, -1, axis=0), strict=True):
            if y0 != y1:  # a ray to the right crosses the side
                inside ^= ((y0 > y) != (y1 > y)) & (x < x0 + (x1 - x0) * (y - y0) / (y1 - y0))
        return np.asarray(inside & ahead)


@dataclass(frozen=True)
class FloaterRemoval:
    """Which splats are floaters."""

    views: int = 64
    """Views along the path that are rendered."""
    margin: float = 1.25
    """Their width and height over those of the recorded pictures: what lies at their edges is seen beside the path."""
    least_px: float = 0.05
    """Pixels that a splat has to fill in a view to be seen in it, all that hide it counted."""
    least_views: int = 2
    """Views that have to see a splat."""
    neighbours: int = 8
    """Neighbours of a splat that say how lonely it is, by the distance to the last of them: a floater's is ..."""
    lonely: float = 8.0
    """... more than so many medians of the scene, both over the depth of the nearest view that sees the splat ..."""
    apart: float = 4.0
    """... and more than so many of its largest standard deviations."""
    span_percentiles: tuple[float, float] = (1, 99)
    """Percentiles of the means along each axis that give the size of the scene."""
    span_share: float = 1 / 12
    """Largest standard deviation of a splat over the size of the scene: three of them are a quarter of it."""
    split: bool = True
    """Replace larger splats by smaller ones that together show the same (`spiked.splitting`)."""

    def span(self, scene: Scene) -> float:
        """Size of the scene, in its unit."""
        low, high = np.percentile(scene.means, self.span_percentiles, axis=0)
        return float(np.linalg.norm(high - low))

    def floaters(self, scene: Scene, seen: "Seen") -> Mask:
        """Splats [N] to be removed.

        The spacing of splats on a surface grows with its distance from the camera, which is why it is measured as an
        angle: far surfaces are no floaters.
        """
        count = min(self.neighbours + 1, len(scene))
        found = np.asarray(scipy.spatial.cKDTree(scene.means).query(scene.means, count)[0])
        distances = found.reshape(len(scene), -1)[:, -1]
        angles = distances / seen.nearest
        usual = float(np.median(angles[seen.views > 0])) if seen.views.any() else 0.0
        lonely = angles > self.lonely * max(usual, 1e-12)
        apart = distances > self.apart * np.exp(scene.log_scales.max(axis=1))
        return np.asarray((seen.views < self.least_views) | (lonely & apart))


@dataclass(frozen=True, eq=False)
class Seen:
    """How views see the splats of a scene."""

    views: NDArray[np.int64]
    """Views that see each splat, [N]."""
    nearest: NDArray[np.float64]
    """Depth of each in the nearest of them, [N]; infinite for a splat that none sees."""


@dataclass(frozen=True)
class Cleaned:
    """A cleaned scene, and what was done."""

    scene: Scene
    outside: int
    """Splats that lay outside the box."""
    outlined: int
    """Splats that lay inside the outline."""
    floaters: int
    """Splats that were removed as floaters."""
    split: int
    """Splats that were larger than a quarter of the scene, and were replaced by several."""
    shrunk: int
    """Splats so large that no view sees: they were made smaller."""
    large: int
    """Splats that stay so large: as several they would be too many (`spiked.splitting`)."""


def clean(
    scene: Scene,
    path: Trajectory,
    camera: Camera | None,
    box: Box | None = None,
    removal: FloaterRemoval | None = None,
    progress: Callable[[float], None] | None = None,
    outline: Outline | None = None,
) -> Cleaned:
    """The scene without what is outside of `box` or inside of `outline`; with a `removal` also without floaters and
    without splats larger than a quarter of it.

    Views of `camera` along `path` tell floaters; a box and an outline need neither. Raises ConfigurationError where
    they are not known, and if nothing would be left.
    """
    kept = scene if box is None else scene.select(box.contains(scene))
    outside, outlined, floaters, split, shrunk, large = len(scene) - len(kept), 0, 0, 0, 0, 0
    if outline is not None:
        chosen = outline.contains(kept)
        outlined, kept = int(chosen.sum()), kept.select(~chosen)
    if removal is not None and len(kept):
        if camera is None or not len(path):
            raise ConfigurationError("the camera or the path of this scene is not known, so no view can tell floaters")
        rows = evenly(len(path), removal.views)
        seen = _seen(kept, path, camera.wider(removal.margin), rows, removal.least_px, _part(progress, SEEN, 0))
        chosen = removal.floaters(kept, seen)
        floaters = int(chosen.sum())
        kept = kept.select(~chosen)
    if not len(kept):
        raise ConfigurationError("nothing of the scene would be left: choose a larger box or a smaller outline")
    if removal is not None and removal.split and camera is not None:
        span = removal.span(kept)
        done = split_large(kept, removal.span_share * span, path, camera, span, _part(progress, 1 - SEEN, SEEN))
        kept, split, shrunk, large = done.scene, done.split, done.shrunk, done.left
    return Cleaned(kept, outside, outlined, floaters, split, shrunk, large)


def _part(progress: Callable[[float], None] | None, share: float, begin: float) -> Callable[[float], None] | None:
    """Progress of a part of the work."""
    return None if progress is None else lambda done: progress(begin + share * done)


def _seen(
    scene: Scene,
    path: Trajectory,
    camera: Camera,
    rows: list[int],
    least_px: float,
    progress: Callable[[float], None] | None,
) -> Seen:
    rasteriser = rasteriser_for(camera)
    views, nearest = np.zeros(len(scene), np.int64), np.full(len(scene), np.inf)
    for done, row in enumerate(rows, 1):
        rotation, centre = path.rotations[row], path.centres[row]
        image = rasteriser.forward(scene, rotation[None], centre[None])
        # Each colour enters the image with the weight of its splat.
        weights = rasteriser.backward(np.ones_like(image.values)).colours
        here = weights.reshape(len(scene), -1).mean(axis=1) >= least_px
        views += here
        nearest[here] = np.minimum(nearest[here], (scene.means[here] - centre) @ rotation[:, 2])
        if progress is not None:
            progress(done / len(rows))
    return Seen(views, nearest)
