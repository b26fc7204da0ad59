"""A result and all that belongs to it as one ZIP file: report, scene, trajectory in four formats, pictures."""

import json
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import BinaryIO

from spiked.errors import SceneError
from spiked.trajectory import colmap_camera, colmap_lines, kitti_lines, nerfstudio_lines, tum_lines
from spiked_service.results.image_encoding import ImageFormat
from spiked_service.results.map_folder import PATHS, file_name
from spiked_service.results.report.page import report_html
from spiked_service.results.report.source import ReportSource, without_folders
from spiked_service.results.report.zip_stream import Part, zip_pieces

_CHUNK_BYTES = 1 << 20
"""Bytes of a file read at a time."""
_README = """Results of spiked, {name}

report.html      all figures, plots and pictures; opens in any browser, also offline
report.json      the same figures for programs
scene.ply        3D Gaussian splats; colours are radiance in spikes a frame, a comment says which is white
trajectory.tum   timestamp_s tx ty tz qx qy qz qw
trajectory.kitti.txt
                 upper three rows of each matrix; times are not kept
colmap/          COLMAP's text model, without points
transforms.json  nerfstudio
pictures/        what the camera saw, and what the scene shows from there
paths/           of a map of several recordings: the path of each
recording.json   sidecar of the recording: geometry, rate, optics, gaps
recording.dat    its frames, if they were asked for

Poses are camera to world with OpenCV's axes (x right, y down, z forward) in TUM and KITTI, world to camera in COLMAP,
and camera to world with OpenGL's axes in transforms.json. A time is the middle of a frame, in seconds since the first.
Files that this result does not have are missing.
"""


def bundle_pieces(source: ReportSource) -> Iterator[bytes]:
    """The ZIP file, piece by piece. Its large files are open from now on: a version may be removed meanwhile.

    Raises SceneError if one has just been.
    """
    try:
        opened = {path: path.open("rb") for path in (source.scene, source.recording) if path is not None}
    except OSError as error:
        raise SceneError(f"{error.filename} was removed: {error.strerror}; ask for the newest version") from error
    return zip_pieces(_parts(source, opened), source.at)


def bundle_name(source: ReportSource) -> str:
    """Name of the file, and of the folder in it."""
    return file_name(source.name)


def _parts(source: ReportSource, opened: Mapping[Path, BinaryIO]) -> Iterator[Part]:
    top = bundle_name(source)
    for part in _files(source, opened):
        yield Part(f"{top}/{part.name}", part.content, part.packed)


def _files(source: ReportSource, opened: Mapping[Path, BinaryIO]) -> Iterator[Part]:
    yield Part("README.txt", [_README.format(name=source.name).encode("utf-8", "replace")])
    yield Part("report.html", [report_html(source).encode("utf-8", "replace")])
    yield Part("report.json", [json.dumps(source.document, indent=1).encode("utf-8", "replace")])
    if source.poses:
        yield from _trajectories(source)
    for name, pieces in source.others.items():
        yield Part(f"{PATHS}/{file_name(name)}.tum", _encoded(tum_lines(pieces())))
    for number, pair in enumerate(source.pairs):
        for kind, encoded in (("observed", pair.observed), ("rendered", pair.rendered)):
            if encoded is not None:
                yield Part(f"pictures/{number:02d}-{kind}.png", [encoded[ImageFormat.PNG]], packed=False)
    if source.scene is not None:
        yield Part("scene.ply", _content(opened[source.scene]))
    if source.sidecar is not None:
        yield Part("recording.json", [_sidecar(source.sidecar)])
    if source.recording is not None:
        yield Part("recording.dat", _content(opened[source.recording]), packed=False)


def _trajectories(source: ReportSource) -> Iterator[Part]:
    written = _encoded(tum_lines(source.pieces())) if source.tum is None else _content(source.tum.open("rb"))
    yield Part("trajectory.tum", written)
    yield Part("trajectory.kitti.txt", _encoded(kitti_lines(source.pieces())))
    sensor = source.sensor
    if sensor is not None and sensor.intrinsics is not None:
        yield Part("colmap/cameras.txt", [colmap_camera(sensor).encode()])
        yield Part("colmap/images.txt", _encoded(colmap_lines(source.pieces())))
        yield Part("colmap/points3D.txt", [b"# no points: the poses are from splats\n"])
        yield Part("transforms.json", _encoded(nerfstudio_lines(source.pieces(), sensor)))


def _sidecar(path: Path) -> bytes:
    """A sidecar without the folders of this machine, in which its calibration may lie."""
    content = path.read_bytes()
    try:
        return json.dumps(without_folders(json.loads(content)), indent=1).encode()
    except ValueError:
        return content


def _encoded(lines: Iterable[str]) -> Iterator[bytes]:
    return (line.encode() for line in lines)


def _content(file: BinaryIO) -> Iterator[bytes]:
    with file:
        while piece := file.read(_CHUNK_BYTES):
            yield piece
