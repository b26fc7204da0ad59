"""A mesh: rendered depths in a truncated signed distance function (Curless and Levoy 1996), then marching cubes.

The volume is dense and cubic; only voxels near a surface point are computed.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from spiked.errors import SceneError
from spiked.export.kind import ExportKind, optional
from spiked.export.source import ExportOptions, ExportSource
from spiked.export.surface import SurfacePoints, fused
from spiked.export.views import Doubles, Floats, RenderedView, rendered_views

__all__ = ["GLB", "PLY", "Mesh", "mesh_of"]

TRUNCATION = 4
"""Voxels from the surface at which distances are cut off."""
BLOCK = 8
"""Voxels along an edge of the blocks that are computed or not."""
LEAST_WEIGHT = 2
"""Views that have to see a voxel."""
SMALLEST_PART = 1e-3
"""Triangles of a connected part over those of the whole mesh, at least."""


@dataclass(frozen=True)
class Mesh:
    """Triangles in world coordinates."""

    vertices: Doubles
    """[n, 3]."""
    faces: NDArray[np.int64]
    """Rows of `vertices`, [m, 3], counter-clockwise seen from outside."""
    colours: NDArray[np.uint8]
    """RGB of the vertices, linear, [n, 3]."""


@dataclass(frozen=True)
class _Volume:
    origin: Doubles
    step: float
    shape: tuple[int, int, int]
    voxels: NDArray[np.int64]
    """Those near a surface, [m, 3]."""

    def positions(self) -> Doubles:
        return np.asarray(self.origin + (self.voxels + 0.5) * self.step)


def mesh_of(source: ExportSource, options: ExportOptions) -> Mesh:
    """The surface that the key views show. Raises SceneError if there is none, and ConfigurationError."""
    measure: Any = optional("skimage.measure")
    views = list(rendered_views(source, options))
    points = fused(source, views, options.resolution)
    volume = _volume(points, options.resolution)
    distance, weight = _integrated(volume, views)
    dense = np.ones(volume.shape, np.float32)
    known = np.zeros(volume.shape, bool)
    at = tuple(volume.voxels.T)
    dense[at], known[at] = distance, weight >= LEAST_WEIGHT
    try:
        vertices, faces, _, _ = measure.marching_cubes(dense, 0.0, mask=known)
    except (ValueError, RuntimeError) as error:
        raise SceneError(f"{source.name} shows no closed surface: {error}; try more --views") from error
    faces = faces[_among(known, vertices)[faces].all(1)]
    placed = volume.origin + (vertices + 0.5) * volume.step
    return _cleaned(placed, faces.astype(np.int64), points)


def _among(known: NDArray[np.bool_], vertices: Floats) -> NDArray[np.bool_]:
    """Vertices [n] that lie between two known voxels: marching cubes makes others at the border of what is known."""
    low, high = np.floor(vertices).astype(int), np.ceil(vertices).astype(int)
    return np.asarray(known[tuple(low.T)] & known[tuple(high.T)])


def _volume(points: SurfacePoints, resolution: int) -> _Volume:
    low, high = points.extent()
    step = max(float((high - low).max()), 1e-9) / resolution
    low, high = low - TRUNCATION * step, high + TRUNCATION * step
    blocks = np.ceil((high - low) / (step * BLOCK)).astype(int) + 1
    inside = points.positions[((points.positions >= low) & (points.positions < high)).all(1)]
    filled = np.zeros(tuple(blocks), bool)
    filled[tuple(np.floor((inside - low) / (step * BLOCK)).astype(int).T)] = True
    filled = binary_dilation(filled, np.ones((3, 3, 3), bool))
    corners = np.argwhere(filled) * BLOCK
    within = np.stack(np.meshgrid(*(np.arange(BLOCK),) * 3, indexing="ij"), -1).reshape(-1, 3)
    shape = tuple(int(side) for side in blocks * BLOCK)
    return _Volume(low, step, (shape[0], shape[1], shape[2]), (corners[:, None] + within).reshape(-1, 3))


def _integrated(volume: _Volume, views: Sequence[RenderedView]) -> tuple[Floats, NDArray[np.int32]]:
    """Mean distance over the truncation, positive in front of the surface, and the number of views, both [m]."""
    positions = volume.positions()
    total = np.zeros(len(positions), np.float32)
    weight = np.zeros(len(positions), np.int32)
    reach = TRUNCATION * volume.step
    for view in views:
        local = view.in_camera(positions)
        rows = np.flatnonzero(local[:, 2] > 0)
        depth = view.sampled_depth(view.camera.intrinsics.project(local[rows]))
        signed = depth - local[rows, 2]
        seen = (depth > 0) & (signed > -reach)
        rows = rows[seen]
        total[rows] += np.minimum(signed[seen] / reach, 1).astype(np.float32)
        weight[rows] += 1
    return np.where(weight > 0, total / np.maximum(weight, 1), 1).astype(np.float32), weight


def _cleaned(vertices: Doubles, faces: NDArray[np.int64], points: SurfacePoints) -> Mesh:
    """Without small parts and unused vertices, with the colours of the nearest surface points."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    graph = coo_array((np.ones(len(edges), bool), (edges[:, 0], edges[:, 1])), (len(vertices),) * 2)
    _, part = connected_components(graph, directed=False)
    sizes = np.bincount(part[faces[:, 0]], minlength=part.max() + 1)
    faces = faces[sizes[part[faces[:, 0]]] >= SMALLEST_PART * len(faces)]
    used, flat = np.unique(faces, return_inverse=True)
    vertices = vertices[used]
    _, nearest = cKDTree(points.positions).query(vertices)
    return Mesh(vertices, flat.reshape(-1, 3), points.colours[nearest])


def _write(source: ExportSource, path: Path, options: ExportOptions, kind: str) -> str:
    trimesh: Any = optional("trimesh")
    mesh = mesh_of(source, options)
    made = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=mesh.colours, process=False)
    path.write_bytes(made.export(file_type=kind))
    return f"{len(mesh.vertices)} vertices, {len(mesh.faces)} triangles"


PLY = ExportKind(
    name="mesh-ply",
    title="triangle mesh with colours: PLY",
    readers="MeshLab, Blender, CloudCompare",
    loses="transparency, details smaller than a voxel",
    suffix=".ply",
    fill=lambda source, path, options: _write(source, path, options, "ply"),
    packages=("skimage", "trimesh"),
)
GLB = ExportKind(
    name="mesh-glb",
    title="triangle mesh with colours: glTF 2.0 in one file",
    readers="Blender, Windows, browsers, game engines",
    loses="transparency, details smaller than a voxel",
    suffix=".glb",
    fill=lambda source, path, options: _write(source, path, options, "glb"),
    packages=("skimage", "trimesh"),
    media_type="model/gltf-binary",
)
