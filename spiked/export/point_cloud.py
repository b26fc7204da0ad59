"""Point clouds with normals and colours, as PLY and as PCD."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from spiked.export.kind import ExportKind
from spiked.export.source import ExportOptions, ExportSource
from spiked.export.surface import SurfacePoints, surface_points
from spiked.ply_header import ply_header

__all__ = ["PCD", "PLY", "pcd", "ply"]

_PLY = np.dtype(
    [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")] + [(name, "u1") for name in ("red", "green", "blue")]
)
_PCD = np.dtype([(name, "<f4") for name in ("x", "y", "z", "normal_x", "normal_y", "normal_z")] + [("rgb", "<u4")])
_TYPES = {"f4": "float", "u1": "uchar"}


def ply(points: SurfacePoints, notes: Iterable[str] = ()) -> bytes:
    """A binary PLY: positions and normals as floats, red, green and blue as bytes; `notes` become comments."""
    table = np.zeros(len(points), _PLY)
    _fill(table, points, ("nx", "ny", "nz"))
    for number, name in enumerate(("red", "green", "blue")):
        table[name] = points.colours[:, number]
    properties = [f"{_TYPES[_PLY[name].str[1:]]} {name}" for name in _PLY.names or ()]
    return ply_header([("vertex", len(points), properties)], notes) + table.tobytes()


def pcd(points: SurfacePoints, notes: Iterable[str] = ()) -> bytes:
    """A binary PCD of version 0.7, as the Point Cloud Library documents it; colours are packed into `rgb`.

    `notes` become comments.
    """
    table = np.zeros(len(points), _PCD)
    _fill(table, points, ("normal_x", "normal_y", "normal_z"))
    red, green, blue = points.colours.T.astype(np.uint32)
    table["rgb"] = red << 16 | green << 8 | blue
    names = _PCD.names or ()
    head = [
        "# .PCD v0.7 - Point Cloud Data file format",
        *(f"# {note}" for note in notes),
        "VERSION 0.7",
        f"FIELDS {' '.join(names)}",
        f"SIZE {' '.join('4' for _ in names)}",
        f"TYPE {' '.join('F' if name != 'rgb' else 'U' for name in names)}",
        f"COUNT {' '.join('1' for _ in names)}",
        f"WIDTH {len(points)}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {len(points)}",
        "DATA binary\n",
    ]
    return "\n".join(head).encode() + table.tobytes()


def _fill(table: NDArray[np.void], points: SurfacePoints, normal: tuple[str, str, str]) -> None:
    for number, name in enumerate("xyz"):
        table[name] = points.positions[:, number]
        table[normal[number]] = points.normals[:, number]


def _write_ply(source: ExportSource, path: Path, options: ExportOptions) -> str:
    points = surface_points(source, options)
    path.write_bytes(ply(points, source.scale.notes))
    return f"{len(points)} points"


def _write_pcd(source: ExportSource, path: Path, options: ExportOptions) -> str:
    points = surface_points(source, options)
    path.write_bytes(pcd(points, source.scale.notes))
    return f"{len(points)} points"


PLY = ExportKind(
    name="points-ply",
    title="point cloud with normals and colours: PLY",
    readers="CloudCompare, MeshLab, Open3D, Blender",
    loses="transparency; surfaces that fewer than three views see",
    suffix=".ply",
    fill=_write_ply,
)
PCD = ExportKind(
    name="points-pcd",
    title="point cloud with normals and colours: PCD",
    readers="PCL, CloudCompare, Open3D",
    loses="transparency; surfaces that fewer than three views see",
    suffix=".pcd",
    fill=_write_pcd,
)
