"""A COLMAP project: pictures, and a sparse model with cameras, poses and points with tracks, as binary files.

The files are those of COLMAP's documentation ("Output Format"), little-endian.
"""

import json
import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from spiked.errors import SceneError
from spiked.export.images import write_png
from spiked.export.kind import ExportKind
from spiked.export.pictures import KeyPicture, key_pictures
from spiked.export.source import ExportOptions, ExportSource, optics_of
from spiked.export.tracks import Tracks, find_tracks
from spiked.export.views import rendered_views
from spiked.pose import quaternion
from spiked.sensor import Sensor
from spiked.trajectory import colmap_lens

__all__ = ["KIND"]

SCALE = "scale.json"
"""What is known of the unit and of up, which COLMAP's files have no place for."""
MODELS = {"PINHOLE": 1, "OPENCV": 4, "OPENCV_FISHEYE": 5, "FULL_OPENCV": 6}
"""Numbers of the camera models."""


def fill(source: ExportSource, folder: Path, options: ExportOptions) -> str:
    """Write images/, sparse/0/ and scale.json. Raises SceneError and ConfigurationError."""
    pictures, tracks = write_pictures(source, folder, options)
    model = folder / "sparse" / "0"
    model.mkdir(parents=True, exist_ok=True)
    (model / "cameras.bin").write_bytes(cameras_bin(source.seen_by(options)))
    (model / "images.bin").write_bytes(images_bin(pictures, tracks))
    (model / "points3D.bin").write_bytes(points_bin(tracks))
    (folder / SCALE).write_text(json.dumps(source.scale.known, indent=1), "utf-8")
    return said(pictures, tracks)


def write_pictures(source: ExportSource, folder: Path, options: ExportOptions) -> tuple[list[KeyPicture], Tracks]:
    """Write images/: the pictures of the key views, which are returned with the points that they show.

    Raises SceneError if there are fewer than two, and ConfigurationError.
    """
    source.need_recording()
    pictures = list(key_pictures(source, options, rendered_views(source, options)))
    if len(pictures) < 2:
        raise SceneError(f"{source.name} has {len(pictures)} pictures with a pose; give more --views")
    tracks = find_tracks(pictures)
    (folder / "images").mkdir(exist_ok=True)
    for picture in pictures:
        write_png(folder / "images" / picture.name, picture.colour())
    return pictures, tracks


def said(pictures: Sequence[KeyPicture], tracks: Tracks) -> str:
    """The figures of a model, for the user."""
    error = f", median reprojection error {tracks.median_error_px:.2f} px" if len(tracks.points) else ""
    return f"{len(pictures)} pictures, {len(tracks.points)} points{error}"


def cameras_bin(sensor: Sensor) -> bytes:
    """One camera."""
    k = optics_of(sensor)
    model, lens = colmap_lens(k.distortion)
    parameters = [k.fx, k.fy, k.cx, k.cy, *lens.values()]
    head = struct.pack("<QiiQQ", 1, 1, MODELS[model], sensor.width, sensor.height)
    return head + struct.pack(f"<{len(parameters)}d", *parameters)


def images_bin(pictures: Sequence[KeyPicture], tracks: Tracks) -> bytes:
    """Poses and observations; picture number n has the id n + 1, as has point n."""
    parts = [struct.pack("<Q", len(pictures))]
    observation = np.dtype([("xy", "<f8", 2), ("point", "<u8")])
    for number, picture in enumerate(pictures):
        rotation = picture.view.rotation.T
        pose = [*quaternion(rotation), *(-rotation @ picture.view.centre)]
        rows = np.flatnonzero(tracks.seen[:, number])
        table = np.zeros(len(rows), observation)
        table["xy"], table["point"] = tracks.pixels[rows, number], rows + 1
        head = struct.pack("<I7dI", number + 1, *pose, 1)
        parts += [head, picture.name.encode() + b"\0", struct.pack("<Q", len(rows)), table.tobytes()]
    return b"".join(parts)


def points_bin(tracks: Tracks) -> bytes:
    """Points with their tracks: of each element the picture, and the number of the observation in it."""
    places = np.cumsum(tracks.seen, 0) - 1
    parts = [struct.pack("<Q", len(tracks.points))]
    for row, (point, colour) in enumerate(zip(tracks.points, tracks.colours, strict=True)):
        views = np.flatnonzero(tracks.seen[row])
        error = float(tracks.errors[row, views].mean())
        track = np.stack([views + 1, places[row, views]], 1).astype("<u4")
        parts += [struct.pack("<Q3d3Bd", row + 1, *point, *colour.tolist(), error), struct.pack("<Q", len(views))]
        parts.append(track.tobytes())
    return b"".join(parts)


KIND = ExportKind(
    name="colmap",
    title="COLMAP project: pictures, poses, cameras, points with tracks",
    readers="COLMAP, gsplat, 3DGS, nerfstudio, Brush, OpenSplat, Metashape",
    loses="splats; poses between the pictures",
    suffix="",
    fill=fill,
    stale=("images/*",),
)
