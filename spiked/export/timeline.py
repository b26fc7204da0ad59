"""What happened when: the contents of the formats that replay a recording with time."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spiked.distortion import LensModel
from spiked.errors import SceneError
from spiked.export.pictures import key_pictures
from spiked.export.source import ExportOptions, ExportSource
from spiked.export.surface import SurfacePoints, fused
from spiked.export.views import Doubles, RenderedView, rendered_views
from spiked.pose import quaternion
from spiked.rates import levels
from spiked.render import Camera

__all__ = ["CAMERA", "MAP", "WORLD", "CameraMessage", "KeyFrame", "Timeline", "camera_message", "read_timeline"]

WORLD, CAMERA, MAP = "world", "camera_optical", "map"
"""Frames of reference: of the scene, of the camera with OpenCV's axes, and the scene with z up as ROS has it."""
MAP_TO_WORLD_XYZW = (-0.5, 0.5, -0.5, 0.5)
"""Rotation of `WORLD` (y down, z forward) in `MAP` (x forward, z up): REP 103, of a body and its optical frame."""
POINT = np.dtype([(axis, "<f4") for axis in "xyz"] + [(name, "u1") for name in ("red", "green", "blue", "alpha")])
"""A point in a message."""
PIXEL_CENTRE = 0.5
"""Coordinate of the first pixel's centre here; ROS and Foxglove have OpenCV's 0."""


@dataclass(frozen=True)
class KeyFrame:
    """A key view with its picture."""

    view: RenderedView
    stamp_ns: int
    pixels: NDArray[np.uint8]
    """[H, W], RGB [H, W, 3] of a mosaic; linear."""


@dataclass(frozen=True)
class Timeline:
    """The poses of a path and what its key views show."""

    stamps_ns: NDArray[np.int64]
    """Of the poses [n]: Unix time, or since frame 0 of a capture whose clock is not known."""
    centres: Doubles
    """Camera positions [n, 3]."""
    quats_xyzw: Doubles
    """Camera-to-world rotations [n, 4]."""
    keys: Sequence[KeyFrame]
    points: SurfacePoints
    """In world coordinates."""
    recorded: bool
    """Whether the pictures are of the recording; otherwise they are rendered."""
    unix: bool
    """Whether stamps are Unix times."""

    @property
    def camera(self) -> Camera:
        """Of the key views."""
        return self.keys[0].view.camera

    def said(self) -> str:
        """Its contents, for the user."""
        kind = "pictures" if self.recorded else "rendered pictures (the recording is not at hand)"
        return f"{len(self.stamps_ns)} poses, {len(self.keys)} {kind} and depth maps, {len(self.points)} points"

    def point_table(self) -> NDArray[np.void]:
        """The points as `POINT`."""
        table = np.zeros(len(self.points), POINT)
        for number, (axis, colour) in enumerate(zip("xyz", ("red", "green", "blue"), strict=True)):
            table[axis], table[colour] = self.points.positions[:, number], self.points.colours[:, number]
        table["alpha"] = 255
        return table


def read_timeline(source: ExportSource, options: ExportOptions) -> Timeline:
    """The timeline of a reconstruction. Raises SceneError and ConfigurationError."""
    views = list(rendered_views(source, options))
    path = source.path
    keys = _recorded(source, options, views) if source.recording is not None else _rendered(source, views)
    if not keys:
        raise SceneError(f"{source.name} has no pictures with a pose; give more --views")
    return Timeline(
        stamps_ns=stamps_ns(source, path.times_s),
        centres=path.centres,
        quats_xyzw=quaternion(path.rotations)[:, [1, 2, 3, 0]],
        keys=keys,
        points=fused(source, views, options.resolution),
        recorded=source.recording is not None,
        unix=_has_clock(source),
    )


def stamps_ns(source: ExportSource, times_s: Doubles) -> NDArray[np.int64]:
    """Unix times of times of the capture, or times since its frame 0 if the recording has no clock."""
    recording = source.recording
    if recording is None or not _has_clock(source):
        return np.rint(times_s * 1e9).astype(np.int64)
    # Clock pairs say when a frame had arrived whole: frame k at (k + 1) / rate.
    return recording.unix_ns(times_s * recording.sensor.frame_rate_hz - source.first_frame - 1)


def _has_clock(source: ExportSource) -> bool:
    return source.recording is not None and bool(source.recording.clock)


def _recorded(source: ExportSource, options: ExportOptions, views: list[RenderedView]) -> list[KeyFrame]:
    pictures = list(key_pictures(source, options, views))
    stamps = stamps_ns(source, np.array([one.view.time_s for one in pictures]))
    return [KeyFrame(one.view, int(at), one.pixels) for one, at in zip(pictures, stamps, strict=True)]


def _rendered(source: ExportSource, views: list[RenderedView]) -> list[KeyFrame]:
    stamps = stamps_ns(source, np.array([view.time_s for view in views]))
    return [KeyFrame(view, int(at), levels(view.colour, source.white)) for view, at in zip(views, stamps, strict=True)]


@dataclass(frozen=True)
class CameraMessage:
    """A camera as CameraInfo of ROS and CameraCalibration of Foxglove have it: centres of pixels are whole numbers."""

    model: str
    """Name of the distortion model."""
    d: tuple[float, ...]
    k: tuple[float, ...]
    """The matrix of the camera, 9 values row by row."""
    p: tuple[float, ...]
    """The same with a column of zeros, 12 values."""


def camera_message(camera: Camera, fisheye: str) -> CameraMessage:
    """The message of a camera; `fisheye` is the format's name of Kannala and Brandt's model."""
    i = camera.intrinsics
    cx, cy = i.cx - PIXEL_CENTRE, i.cy - PIXEL_CENTRE
    lens = i.distortion
    model = fisheye if lens is not None and lens.model is LensModel.FISHEYE else "plumb_bob"
    d = (0.0,) * 5 if lens is None else lens.coefficients
    k = (i.fx, 0.0, cx, 0.0, i.fy, cy, 0.0, 0.0, 1.0)
    p = (i.fx, 0.0, cx, 0.0, 0.0, i.fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0)
    return CameraMessage(model, d, k, p)
