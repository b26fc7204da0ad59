"""Trajectories over HTTP: a range of the poses of a version in one of the formats, streamed in pieces."""

import threading
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np
import orjson
from fastapi import Request, Response
from numpy.typing import NDArray

from spiked.errors import ConfigurationError, SceneError
from spiked.frame_of_reference import KnownScale
from spiked.pose import Array
from spiked.poses import PoseFile, Records, convert_tum
from spiked.sensor import Sensor
from spiked.trajectory import (
    Trajectory,
    colmap_camera,
    colmap_lines,
    kitti_lines,
    nerfstudio_lines,
    tum_lines,
)
from spiked_service.api import files
from spiked_service.api.problems import GoneError, NoPoseError
from spiked_service.api.streams import GuardedStream
from spiked_service.base.limits import ConcurrencyLimit
from spiked_service.results.published import Published
from spiked_service.results.report.zip_stream import Part, zip_pieces
from spiked_service.results.scene_scale import MetricPoses, scale_headers
from spiked_service.results.timeline import Timeline, frames_at
from spiked_service.results.versions import pose_file

_PIECE = 4096
"""Poses of a piece: between pieces other requests run and a disconnect of the client is noticed."""
_KEPT = 48
"""Pieces cached for all columns of JSON: with a large step every pose is on another page of the file."""
_DECIMALS = 9
"""Decimals of positions and quaternions in JSON."""
_CONVERTING = threading.Lock()


class TrajectoryFormat(StrEnum):
    """How a trajectory is written."""

    JSON = "json"
    TUM = "tum"
    KITTI = "kitti"
    COLMAP = "colmap"
    """A ZIP of cameras.txt, images.txt and an empty points3D.txt, as COLMAP's text model."""
    NERFSTUDIO = "nerfstudio"


TRAJECTORY_TYPES = {
    TrajectoryFormat.JSON: ("application/json", "json"),
    TrajectoryFormat.TUM: ("text/plain; charset=utf-8", "tum"),
    TrajectoryFormat.KITTI: ("text/plain; charset=utf-8", "kitti.txt"),
    TrajectoryFormat.COLMAP: ("application/zip", "colmap.zip"),
    TrajectoryFormat.NERFSTUDIO: ("application/vnd.nerfstudio+json", "transforms.json"),
}


@dataclass(frozen=True)
class Range:
    """A part of a trajectory."""

    from_s: float | None
    to_s: float | None
    step: int

    def of(self, poses: PoseFile) -> range:
        """The rows with from_s <= time < to_s, every step-th. Raises NoPoseError if there are none."""
        rows = poses.between(
            -np.inf if self.from_s is None else self.from_s, np.inf if self.to_s is None else self.to_s
        )
        if not rows:
            raise NoPoseError(
                f"no pose lies in this range; there are poses from {poses.time_s(0):.6f} to {poses.time_s(-1):.6f} s"
                if len(poses)
                else "this version has no poses"
            )
        return rows[:: self.step]


def open_poses(folder: Path, published: Published, sensor: Sensor | None, timeline: Path) -> PoseFile:
    """The poses of a version. The TUM files of older releases are converted at the first request.

    Raises GoneError if the version has just been let go of, SceneError.
    """
    path, tum = pose_file(folder, published), folder / published.trajectory
    if not path.exists():
        with _CONVERTING:
            if not path.exists():
                _convert(tum, path, sensor, timeline)
    return PoseFile(path)


def _convert(tum: Path, poses: Path, sensor: Sensor | None, timeline: Path) -> None:
    if not tum.exists() or tum == poses:
        raise GoneError("this version was removed; request the newest one")

    def states(times_s: Array) -> NDArray[np.bytes_]:
        return known.states_at(frames_at(times_s, _rate_hz(sensor)))

    known = Timeline.read(timeline)
    try:
        convert_tum(tum, poses, states)
    except OSError as error:
        raise SceneError(f"cannot convert {tum.name}: {error.strerror}; free disk space") from error


def trajectory_response(
    request: Request,
    poses: PoseFile,
    version: int,
    sensor: Sensor | None,
    kind: TrajectoryFormat,
    part: Range,
    concurrency: ConcurrencyLimit,
    scale: KnownScale,
) -> Response:
    """A range of poses in one of the formats, with the scale of its unit; `concurrency` limits concurrent responses.

    Raises NoPoseError, ConfigurationError, OverloadedError.
    """
    frame = poses.frame if isinstance(poses, MetricPoses) else None
    tag = files.etag(version, kind, files.stamp(poses.path), part.from_s, part.to_s, part.step, frame, scale)
    if files.unchanged(request, tag):
        return files.not_modified(tag)
    rows = part.of(poses)
    if kind in (TrajectoryFormat.NERFSTUDIO, TrajectoryFormat.COLMAP) and (sensor is None or sensor.intrinsics is None):
        raise ConfigurationError("this format needs the optics, which are unknown for this capture; use format=tum")
    media_type, ending = TRAJECTORY_TYPES[kind]
    headers = {**files.attached(tag, f"trajectory.{ending}"), "X-Scene-Version": str(version)}
    headers |= scale_headers(scale)
    concurrency.acquire()
    return GuardedStream(
        _written(poses, rows, version, sensor, kind, scale), media_type, headers, over=concurrency.release
    )


def _written(
    poses: PoseFile, rows: range, version: int, sensor: Sensor | None, kind: TrajectoryFormat, scale: KnownScale
) -> Iterator[str] | Iterator[bytes]:
    parts = (poses.trajectory(piece) for piece in _pieces(rows))
    match kind:
        case TrajectoryFormat.TUM:
            return tum_lines(parts, scale.notes)
        case TrajectoryFormat.KITTI:
            return kitti_lines(parts)
        case TrajectoryFormat.JSON:
            return _json(poses, rows, version, _rate_hz(sensor))
        case TrajectoryFormat.NERFSTUDIO:
            assert sensor is not None
            return nerfstudio_lines(parts, sensor, {"scale": scale.known})
        case TrajectoryFormat.COLMAP:
            assert sensor is not None
            return _colmap(parts, sensor, scale.notes)


def _pieces(rows: range) -> Iterator[range]:
    return (rows[first : first + _PIECE] for first in range(0, len(rows), _PIECE))


def _rate_hz(sensor: Sensor | None) -> float:
    return 1.0 if sensor is None else sensor.frame_rate_hz


def _json(poses: PoseFile, rows: range, version: int, rate_hz: float) -> Iterator[bytes]:
    """A `TrajectoryOut`, one column after the other."""
    columns: dict[str, Callable[[Records], Array | NDArray[np.int64]]] = {
        "frames": lambda found: frames_at(found["time_s"], rate_hz),
        "times_s": lambda found: found["time_s"],
        "positions": lambda found: np.round(found["position"], _DECIMALS),
        "quaternions_wxyz": lambda found: np.round(found["quaternion_wxyz"], _DECIMALS),
    }
    kept: dict[range, Records] = {}

    def found() -> Iterator[Records]:
        for piece in _pieces(rows):
            part = kept.get(piece)
            part = poses.records(piece) if part is None else part
            if len(kept) < _KEPT:
                kept[piece] = part
            yield part

    yield b'{"version":%d' % version
    for name, column in columns.items():
        yield from _array(name, (np.ascontiguousarray(column(part)) for part in found()))
    yield from _array("states", ([_state(one) for one in part["state"].tolist()] for part in found()))
    yield b"}"


def _array(name: str, parts: Iterable[NDArray[Any] | list[str | None]]) -> Iterator[bytes]:
    begin = b',"%s":[' % name.encode()
    for part in parts:
        yield begin + orjson.dumps(part, option=orjson.OPT_SERIALIZE_NUMPY)[1:-1]
        begin = b","
    yield b"]"


def _state(known: bytes) -> str | None:
    return known.decode() or None


def _colmap(parts: Iterable[Trajectory], sensor: Sensor, notes: Iterable[str]) -> Iterator[bytes]:
    """A ZIP of a text model without points."""
    images = (text.encode() for text in colmap_lines(parts, notes))
    return zip_pieces(
        [
            Part("cameras.txt", [colmap_camera(sensor).encode()], packed=False),
            Part("images.txt", images, packed=False),
            Part("points3D.txt", [b"# no points: the poses are from splats\n"], packed=False),
        ]
    )
