"""An HDF5 file by NeXus's rules: the frames of the recording, the path, key views and splats.

Groups and fields follow the NeXus definitions (NXentry, NXinstrument, NXdetector, NXdata; manual.nexusformat.org): each
has its class and each array its units; `default` leads a viewer to the depth maps.
"""

from pathlib import Path
from typing import Any

import numpy as np

from spiked.export.kind import ExportKind, optional
from spiked.export.source import ExportOptions, ExportSource, optics_of
from spiked.export.timeline import Timeline, read_timeline
from spiked.export.views import Doubles
from spiked.pose import quaternion
from spiked.recording import Recording
from spiked.scene import unit_quats
from spiked.whole_files import KeptErrors

__all__ = ["KIND"]

CHUNK_FRAMES = 64
"""Frames that are read, compressed and written at a time."""
COMPRESSION: dict[str, Any] = {"compression": "gzip", "compression_opts": 1}
"""zlib, which every reader of HDF5 has, at its fastest level."""
PIXEL_CENTRE = 0.5
"""Coordinate of the first pixel's centre."""


def fill(source: ExportSource, path: Path, options: ExportOptions) -> str:
    """Write a .nxs. Raises SceneError and ConfigurationError."""
    h5py = optional("h5py", "hdf5")
    timeline = read_timeline(source, options)
    with KeptErrors(path, "w+") as raw, h5py.File(raw, "w") as file:
        file.attrs.update({"NX_class": "NXroot", "default": "entry", "creator": "spiked"})
        entry = _group(file, "entry", "NXentry")
        entry.attrs["default"] = "key_views"
        entry["title"] = source.name
        _group(entry, "scale", "NXcollection").attrs.update(source.scale.known)
        detector = _write_camera(entry, source)
        _write_path(entry, timeline, source)
        _write_views(entry, timeline, source)
        _write_points(entry, timeline, source)
        _write_splats(entry, source)
        frames = 0 if source.recording is None else _write_frames(entry, detector, source.recording, raw)
    spikes = f"{frames} frames" if frames else "no frames (the recording is not at hand)"
    return f"{spikes}, {timeline.said()}, {len(source.need_scene())} splats"


def _write_camera(entry: Any, source: ExportSource) -> Any:
    """The detector, which is returned, and its optics."""
    sensor = source.need_sensor()
    k = optics_of(sensor)
    instrument = _group(entry, "instrument", "NXinstrument")
    detector = _group(instrument, "detector", "NXdetector")
    detector["description"] = "spike camera: 1 where a pixel fired during the frame"
    _field(detector, "frame_rate", sensor.frame_rate_hz, "Hz")
    if sensor.mosaic is not None:
        detector["mosaic"] = str(sensor.mosaic)
    optics = _group(instrument, "optics", "NXcollection")
    for name in ("fx", "fy", "cx", "cy"):
        _field(optics, name, getattr(k, name), "pixel")
    optics.attrs["pixel_centre"] = PIXEL_CENTRE
    if k.distortion is not None:
        optics["distortion_model"] = str(k.distortion.model)
        for name, value in k.distortion.named().items():
            optics[name] = value
    return detector


def _write_path(entry: Any, timeline: Timeline, source: ExportSource) -> None:
    """All poses: NXdata of the position over time, and the rotation beside it."""
    path = _group(entry, "path", "NXdata")
    path.attrs.update({"signal": "position", "axes": ["time", "."]})
    _field(path, "time", source.path.times_s, "s")
    _write_poses(path, timeline.centres, timeline.quats_xyzw[:, [3, 0, 1, 2]], source.unit)
    _field(path, "stamp", timeline.stamps_ns, "ns")
    path["stamp"].attrs["start"] = "1970-01-01T00:00:00Z" if timeline.unix else "frame 0 of the capture"


def _write_poses(group: Any, centres: Doubles, quats_wxyz: Doubles, unit: str) -> None:
    """Positions [n, 3] and rotations [n, 4]."""
    _field(group, "position", centres, unit)
    group["position"].attrs["long_name"] = "camera position in world axes, x y z"
    group["quaternion"] = quats_wxyz
    group["quaternion"].attrs["long_name"] = (
        "camera-to-world rotation, w x y z; camera axes are x right, y down, z forward"
    )


def _write_views(entry: Any, timeline: Timeline, source: ExportSource) -> None:
    """Key views: NXdata of the depth maps over time, with pictures and poses."""
    views = _group(entry, "key_views", "NXdata")
    views.attrs.update({"signal": "depth", "axes": ["time", ".", "."]})
    _field(views, "time", np.array([key.view.time_s for key in timeline.keys]), "s")
    depth = np.stack([key.view.depth for key in timeline.keys])
    views.create_dataset("depth", data=depth, chunks=(1, *depth.shape[1:]), **COMPRESSION)
    views["depth"].attrs.update({"units": source.unit, "long_name": "z along the camera's axis; 0: no surface"})
    views["pose"] = np.array([key.view.row for key in timeline.keys])
    views["pose"].attrs["long_name"] = "row of path nearest in time"
    _write_poses(
        views,
        np.stack([key.view.centre for key in timeline.keys]),
        quaternion(np.stack([key.view.rotation for key in timeline.keys])),
        source.unit,
    )
    pictures = np.stack([key.pixels for key in timeline.keys])
    views.create_dataset("picture", data=pictures, chunks=(1, *pictures.shape[1:]), **COMPRESSION)
    views["picture"].attrs["long_name"] = f"linear, {'recorded' if timeline.recorded else 'rendered'}"


def _write_points(entry: Any, timeline: Timeline, source: ExportSource) -> None:
    points = _group(entry, "points", "NXcollection")
    _field(points, "position", timeline.points.positions.astype(np.float32), source.unit)
    points["normal"], points["colour"] = timeline.points.normals, timeline.points.colours


def _write_splats(entry: Any, source: ExportSource) -> None:
    """The scene as it is, without rounding."""
    scene = source.need_scene()
    splats = _group(entry, "splats", "NXcollection")
    _field(splats, "position", scene.means, source.unit)
    _field(splats, "scale", np.exp(scene.log_scales), source.unit)
    splats["scale"].attrs["long_name"] = "standard deviations along the axes"
    splats["quaternion"] = unit_quats(scene.quats)
    splats["quaternion"].attrs["long_name"] = "w x y z"
    splats["opacity"] = scene.opacities
    _field(splats, "radiance", scene.colours, "spikes/frame" if scene.white is not None else "")
    if scene.harmonics is not None:
        splats["harmonics"] = scene.harmonics
        splats["harmonics"].attrs["long_name"] = (
            "spherical harmonics of degree 1 and more as in 3DGS: splat, coefficient, channel"
        )
    splats.attrs["white"] = source.white


def _write_frames(entry: Any, detector: Any, recording: Recording, raw: KeptErrors) -> int:
    """The spikes, uint8 [frames, H, W] of 0 and 1, upright; their indices in the capture say where frames were lost."""
    height, width = recording.sensor.height, recording.sensor.width
    data = detector.create_dataset(
        "data",
        (recording.frames, height, width),
        np.uint8,
        chunks=(min(CHUNK_FRAMES, recording.frames), height, width),
        **COMPRESSION,
    )
    for first in range(0, recording.frames, CHUNK_FRAMES):
        images = recording.images(first, min(CHUNK_FRAMES, recording.frames - first))
        data[first : first + len(images)] = images
        raw.check()
    index = np.arange(recording.frames)
    for gap in sorted(recording.gaps, key=lambda gap: gap.first):
        index[index >= gap.first] += gap.count
    detector["frame"] = index
    detector["frame"].attrs["long_name"] = "index in the capture, from the recording's first frame"
    shown = _group(entry, "spikes", "NXdata")
    shown.attrs.update({"signal": "data", "axes": ["frame", ".", "."]})
    shown["data"], shown["frame"] = data, detector["frame"]
    return recording.frames


def _group(parent: Any, name: str, kind: str) -> Any:
    group = parent.create_group(name)
    group.attrs["NX_class"] = kind
    return group


def _field(group: Any, name: str, value: Any, unit: str) -> None:
    """An array or a number with its unit."""
    group[name] = value
    if unit:
        group[name].attrs["units"] = unit


KIND = ExportKind(
    name="nexus",
    title="HDF5 by NeXus's rules: spikes, path, pictures, depth maps, points, splats",
    readers="h5py, MATLAB, NeXpy, silx, h5web; `spiked convert` reads its spikes",
    loses="nothing",
    suffix=".nxs",
    fill=fill,
    packages=("h5py",),
    extra="hdf5",
)
