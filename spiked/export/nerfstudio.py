"""A folder for nerfstudio: transforms.json, the pictures that it names, and a sparse point cloud."""

import json
from pathlib import Path

import numpy as np

from spiked.export.colmap import said, write_pictures
from spiked.export.kind import ExportKind
from spiked.export.source import ExportOptions, ExportSource
from spiked.export.tracks import Tracks
from spiked.ply_header import ply_header
from spiked.trajectory import Trajectory, nerfstudio_lines

__all__ = ["KIND"]

POINTS = "sparse.ply"
_POINT = np.dtype([("position", "<f4", 3), ("colour", "u1", 3)])


def fill(source: ExportSource, folder: Path, options: ExportOptions) -> str:
    """Write transforms.json, images/ and sparse.ply. Raises SceneError and ConfigurationError."""
    pictures, tracks = write_pictures(source, folder, options)
    views = [picture.view for picture in pictures]
    path = Trajectory(
        np.array([view.time_s for view in views]),
        np.stack([view.rotation for view in views]),
        np.stack([view.centre for view in views]),
    )
    index = json.loads("".join(nerfstudio_lines([path], source.seen_by(options))))
    (folder / "transforms.json").write_text(
        json.dumps({**index, "ply_file_path": POINTS, "scale": source.scale.known}, indent=1), "utf-8"
    )
    (folder / POINTS).write_bytes(_ply(tracks, source.scale.notes))
    return said(pictures, tracks)


def _ply(tracks: Tracks, notes: list[str]) -> bytes:
    table = np.zeros(len(tracks.points), _POINT)
    table["position"], table["colour"] = tracks.points, tracks.colours
    properties = [*(f"float {name}" for name in "xyz"), *(f"uchar {name}" for name in ("red", "green", "blue"))]
    return ply_header([("vertex", len(table), properties)], notes) + table.tobytes()


KIND = ExportKind(
    name="nerfstudio",
    title="nerfstudio folder: transforms.json, pictures, sparse points",
    readers="nerfstudio, instant-ngp, Brush, gsplat",
    loses="splats; poses between the pictures",
    suffix="",
    fill=fill,
    stale=("images/*",),
)
