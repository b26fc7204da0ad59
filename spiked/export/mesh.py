"""A mesh: rendered depths in a truncated signed distance function (Curless and Levoy 1996), then marching cubes.

The volume is dense and cubic; only voxels near a surface point are computed.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

import spiked.native._dense as _dense
from spiked.errors import SceneError
from spiked.export.kind import ExportKind, optional
from spiked.export.source import ExportOptions, ExportSource
from spiked.export.surface import SurfacePoints, fused
from spiked.export.views import Doubles, Floats, RenderedView, rendered_views
from spiked.render.cpu import usable_cores

__all__ = ["GLB", "PLY", "Mesh", "mesh_of"]

TRUNCATION = 4
"""Voxels from the surface at which distances are cut off."""
BLOCK = 8
"""Voxels along an edge of the blocks that are computed or not."""
LEAST_WEIGHT = 2
"""Views that have to see a voxel."""
SHARE = 64
"""Blocks that a thread takes at a time."""
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
    blocks: tuple[int, int, int]
    near: NDArray[np.bool_]
    """Blocks near a surface, `blocks`."""

    def dense(self, values: NDArray[Any], elsewhere: float | bool) -> NDArray[Any]:
        """Values [n, BLOCK**3] of the blocks near a surface as a volume."""
        whole = np.full((*self.blocks, BLOCK**3), elsewhere, values.dtype)
        whole[self.near] = values
        whole = whole.reshape(*self.blocks, BLOCK, BLOCK, BLOCK).transpose(0, 3, 1, 4, 2, 5)
        return whole.reshape([side * BLOCK for side in self.blocks])


def mesh_of(source: ExportSource, options: ExportOptions) -> Mesh:
    """The surface that the key views show. Raises SceneError if there is none, and ConfigurationError."""
    measure: Any = optional("skimage.measure")
    views = list(rendered_views(source, options))
    points = fused(source, views, options.resolution)
    volume = _volume(points, options.resolution)
    distance, seen = _integrated(volume, views)
    dense, known = volume.dense(distance, 1), volume.dense(seen >= LEAST_WEIGHT, False)
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
    filled = scipy.ndimage.binary_dilation(filled, np.ones((3, 3, 3), bool))
    return _Volume(low, step, (int(blocks[0]), int(blocks[1]), int(blocks[2])), filled)


def _integrated(volume: _Volume, views: Sequence[RenderedView]) -> tuple[Floats, NDArray[np.int32]]:
    """Mean distance over the truncation, positive in front of the surface, and the number of views, [n, BLOCK**3]."""
    corners = volume.origin + np.argwhere(volume.near) * (BLOCK * volume.step)
    total = np.zeros((len(corners), BLOCK**3), np.float32)
    seen = np.zeros(total.shape, np.int32)

    def add(rows: slice) -> None:
        for view in views:
            optics = view.camera.intrinsics
            _dense.add_distances(
                corners[rows],
                volume.step,
                BLOCK,
                view.depth,
                view.rotation,
                view.centre,
                np.array([optics.fx, optics.fy, optics.cx, optics.cy]),
                TRUNCATION * volume.step,
                total[rows],
                seen[rows],
                **optics.lens(),
            )

    with ThreadPoolExecutor(usable_cores()) as threads:
        list(threads.map(add, (slice(first, first + SHARE) for first in range(0, len(corners), SHARE))))
    return np.where(seen > 0, total / np.maximum(seen, 1), 1).astype(np.float32), seen


def _cleaned(vertices: Doubles, faces: NDArray[np.int64], points: SurfacePoints) -> Mesh:
    """Without small parts and unused vertices, with the colours of the nearest surface points."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    graph = scipy.sparse.coo_array((np.ones(len(edges), bool), (edges[:, 0], edges[:, 1])), (len(vertices),) * 2)
    _, part = scipy.sparse.csgraph.connected_components(graph, directed=False)
    sizes = np.bincount(part[faces[:, 0]], minlength=part.max() + 1)
    faces = faces[sizes[part[faces[:, 0]]] >= SMALLEST_PART * len(faces)]
    used, flat = np.unique(faces, return_inverse=True)
    vertices = vertices[used]
    _, nearest = scipy.spatial.cKDTree(points.positions).query(vertices)
    return Mesh(vertices, flat.reshape(-1, 3), points.colours[nearest])


def _write(source: ExportSource, path: Path, options: ExportOptions, kind: str) -> str:
    trimesh: Any = optional("trimesh")
    mesh = mesh_of(source, options)
    made = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=mesh.colours, process=False)
    path.write_bytes(_glb(made, source) if kind == "glb" else _noted(made.export(file_type=kind), source.scale.notes))
    return f"{len(mesh.vertices)} vertices, {len(mesh.faces)} triangles"


def _glb(mesh: Any, source: ExportSource) -> Any:
    """The bytes of a glTF; what is known of the unit is in `asset.extras`."""
    return mesh.export(file_type="glb", tree_postprocessor=lambda tree: tree["asset"].update(extras=source.scale.known))


def _noted(ply: bytes, notes: list[str]) -> bytes:
    """A PLY with further comments."""
    comments = "".join(f"comment {note}\n" for note in notes)
    return ply.replace(b"\nelement ", f"\n{comments}element ".encode(), 1)


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
