"""A Rerun recording: the path, pictures and depth maps at their times, points and splats.

Cameras of Rerun are pinholes, so pictures and depth maps are without the lens's distortion. The first pixel's centre is
at (0.5, 0.5) there as here.
"""

from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spiked.export.kind import ExportKind, optional
from spiked.export.source import ExportOptions, ExportSource
from spiked.export.timeline import Timeline, read_timeline
from spiked.harmonics import COEFFICIENTS
from spiked.rates import levels
from spiked.scene import Scene, unit_quats

__all__ = ["KIND"]

TIME = "time"
"""Name of the time line."""


def fill(source: ExportSource, path: Path, options: ExportOptions) -> str:
    """Write a .rrd. Raises SceneError and ConfigurationError."""
    rr = optional("rerun", "rerun")
    timeline = read_timeline(source, replace(options, undistorted=True))
    stream = rr.RecordingStream("spiked", recording_id=source.name)
    memory = stream.memory_recording()  # its writer of files hangs on a full disk
    try:
        _log_static(rr, stream, source, timeline)
        at = rr.TimeColumn(TIME, **_times(timeline, timeline.stamps_ns))
        poses = rr.Transform3D.columns(translation=timeline.centres, quaternion=timeline.quats_xyzw)
        stream.send_columns("world/camera", indexes=[at], columns=poses)
        _log_keys(rr, stream, timeline)
        path.write_bytes(memory.drain_as_bytes())
    finally:
        stream.disconnect()
    return f"{timeline.said()}, {len(source.need_scene())} splats"


def _log_static(rr: ModuleType, stream: Any, source: ExportSource, timeline: Timeline) -> None:
    """Axes, camera, points and splats: what holds at all times."""
    points, camera = timeline.points, timeline.camera
    k = camera.intrinsics
    stream.log("world", rr.ViewCoordinates.RDF, static=True)
    stream.log("world", rr.AnyValues(**source.scale.known), static=True)
    stream.log("world/points", rr.Points3D(points.positions, colors=points.colours), static=True)
    stream.log("world/splats", _splats(rr, source.need_scene(), source.white), static=True)
    stream.log("world/path", rr.LineStrips3D([timeline.centres]), static=True)
    pinhole = rr.Pinhole(
        image_from_camera=[[k.fx, 0, k.cx], [0, k.fy, k.cy], [0, 0, 1]],
        resolution=[camera.width, camera.height],
        camera_xyz=rr.ViewCoordinates.RDF,
    )
    stream.log("world/camera", pinhole, static=True)


def _log_keys(rr: ModuleType, stream: Any, timeline: Timeline) -> None:
    for key in timeline.keys:
        (at,) = _times(timeline, np.array([key.stamp_ns])).items()
        stream.set_time(TIME, **{at[0]: at[1][0]})
        stream.log("world/camera/picture", rr.Image(key.pixels))
        stream.log("world/camera/depth", rr.DepthImage(key.view.depth, meter=1.0))


def _times(timeline: Timeline, stamps_ns: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
    """Stamps as Rerun's argument: a point in time if the clock is known."""
    if timeline.unix:
        return {"timestamp": stamps_ns.astype("datetime64[ns]")}
    return {"duration": stamps_ns.astype("timedelta64[ns]")}


def _splats(rr: ModuleType, scene: Scene, white: float) -> Any:
    """Splats as Rerun keeps them: standard deviations, opacities in the alpha channel, 8 bits of colour."""
    rgb = np.broadcast_to(levels(scene.colours, white), (len(scene), 3))
    return rr.GaussianSplats3D(
        scene.means,
        scales=np.exp(scene.log_scales),
        quaternions=unit_quats(scene.quats)[:, [1, 2, 3, 0]],
        colors=np.concatenate([rgb, np.rint(255 * scene.opacities)[:, None].astype(np.uint8)], 1),
        **_harmonics(scene, white),
    )


def _harmonics(scene: Scene, white: float) -> dict[str, Any]:
    """The arguments of view-dependent colour: coefficients [n, 15, 3]."""
    if scene.harmonics is None:
        return {}
    filled = scene.filled_harmonics(COEFFICIENTS[-1]) / white
    return {"sh_coefficients": np.broadcast_to(filled, (*filled.shape[:2], 3))}


KIND = ExportKind(
    name="rerun",
    title="Rerun recording: path, pictures, depth maps, points, splats",
    readers="the Rerun viewer and its Python reader",
    loses="distortion of the lens (pictures are undistorted); radiance beyond white, colours beyond 8 bits",
    suffix=".rrd",
    fill=fill,
    packages=("rerun",),
    extra="rerun",
)
