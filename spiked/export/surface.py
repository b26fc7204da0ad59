"""Surface points of a scene: pixels of the rendered views on whose depth other views agree."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spiked.errors import SceneError
from spiked.export.source import ExportOptions, ExportSource
from spiked.export.views import Doubles, RenderedView, rendered_views
from spiked.rates import levels

__all__ = ["SurfacePoints", "surface_points"]

AGREEMENT = 0.01
"""Difference of two views' depths of a point, relative to the depth, up to which they agree."""
AGREEING = 2
"""Other views that have to agree, or all if there are fewer."""
COMPARED = 8
"""Views that each view is compared with, evenly spaced along the path."""
INNER = (1.0, 99.0)
"""Percentiles of the coordinates between which the extent of the scene is measured."""


@dataclass(frozen=True)
class SurfacePoints:
    """n points in world coordinates."""

    positions: Doubles
    """[n, 3]."""
    normals: NDArray[np.float32]
    """Unit vectors out of the surface, [n, 3]."""
    colours: NDArray[np.uint8]
    """RGB, linear, [n, 3]."""

    def __len__(self) -> int:
        return len(self.positions)

    def select(self, rows: NDArray[np.int64] | NDArray[np.bool_]) -> "SurfacePoints":
        """Some of the points."""
        return SurfacePoints(self.positions[rows], self.normals[rows], self.colours[rows])

    def extent(self) -> tuple[Doubles, Doubles]:
        """The corners of the box that holds all but the outermost points of each side, `INNER`."""
        low, high = np.percentile(self.positions, INNER, axis=0)
        return low, high


def surface_points(source: ExportSource, options: ExportOptions) -> SurfacePoints:
    """The points of all key views, one for each voxel of half the size of a mesh's. Raises SceneError."""
    return fused(source, list(rendered_views(source, options)), options.resolution)


def fused(source: ExportSource, views: Sequence[RenderedView], resolution: int) -> SurfacePoints:
    """One set of points of some views. Raises SceneError if there is none."""
    parts = [_of_view(view, views, source.white) for view in views]
    whole = SurfacePoints(
        *(np.concatenate([getattr(part, name) for part in parts]) for name in ("positions", "normals", "colours"))
    )
    if not len(whole):
        raise SceneError(f"{source.name} shows no surface from its path: its splats are too transparent")
    low, high = whole.extent()
    step = max(float((high - low).max()), 1e-9) / (2 * resolution)
    cells = np.floor((whole.positions - low) / step).astype(np.int64)
    _, first = np.unique(cells, axis=0, return_index=True)
    return whole.select(np.sort(first))


def _of_view(view: RenderedView, views: Sequence[RenderedView], white: float) -> SurfacePoints:
    normals = view.normals()
    rows, columns = np.nonzero((normals != 0).any(-1))
    points = view.points()[rows, columns]
    others = [other for other in views[:: max(1, len(views) // COMPARED)] if other is not view]
    votes = np.zeros(len(points), np.int64)
    for other in others:
        votes += agrees(other, points)
    keep = votes >= min(AGREEING, len(others))
    colour = levels(view.colour, white)
    rgb = np.broadcast_to(colour if colour.ndim == 3 else colour[..., None], (*colour.shape[:2], 3))[rows, columns]
    outward = (normals[rows, columns] @ view.rotation.T.astype(np.float32)).astype(np.float32)
    return SurfacePoints(points, outward, np.ascontiguousarray(rgb)).select(keep)


def agrees(view: RenderedView, points: Doubles) -> NDArray[np.bool_]:
    """Which of world points [n, 3] the view sees where they are."""
    local = view.in_camera(points)
    z = local[:, 2]
    depth = view.sampled_depth(view.camera.intrinsics.project(local))
    return np.asarray((z > 0) & (depth > 0) & (np.abs(depth - z) < AGREEMENT * z))
