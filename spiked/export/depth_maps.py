"""Depth and normal maps: EXR of floats, and PNG of 16 bits with their scale in depth.json."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from spiked.export.images import LARGEST, read_exr, write_exr, write_png
from spiked.export.kind import ExportKind
from spiked.export.source import ExportOptions, ExportSource, optics_of
from spiked.export.views import RenderedView, rendered_views
from spiked.rates import levels

__all__ = ["KIND"]

INDEX = "depth.json"


def fill(source: ExportSource, folder: Path, options: ExportOptions) -> str:
    """Write depth/, normal/, colour/ and depth.json. Raises SceneError and ConfigurationError."""
    for name in ("depth", "normal", "colour"):
        (folder / name).mkdir(exist_ok=True)
    frames, deepest = [], 0.0
    for view in rendered_views(source, options):
        _write_view(view, folder, source.white)
        frames.append(_frame(view))
        deepest = max(deepest, float(view.depth.max()))
    unit = max(deepest, 1e-9) / LARGEST
    for frame in frames:
        depth = read_exr(folder / frame["depth_exr"])[..., 0]
        write_png(folder / frame["depth_png"], np.rint(depth / unit).clip(0, LARGEST).astype(np.uint16))
    _write_index(source, folder, options, unit, frames)
    return f"{len(frames)} depth and normal maps"


def _write_view(view: RenderedView, folder: Path, white: float) -> None:
    name, normals = _name(view), view.normals()
    write_exr(folder / "depth" / f"{name}.exr", view.depth, ("Z",))
    write_exr(folder / "normal" / f"{name}.exr", normals, ("X", "Y", "Z"))
    write_png(folder / "normal" / f"{name}.png", np.rint((normals + 1) / 2 * LARGEST).astype(np.uint16))
    write_png(folder / "colour" / f"{name}.png", levels(view.colour, white))


def _frame(view: RenderedView) -> dict[str, Any]:
    name = _name(view)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = view.rotation, view.centre
    return {
        "time_s": view.time_s,
        "camera_to_world": pose.tolist(),
        "depth_exr": f"depth/{name}.exr",
        "depth_png": f"depth/{name}.png",
        "normal_exr": f"normal/{name}.exr",
        "normal_png": f"normal/{name}.png",
        "colour": f"colour/{name}.png",
    }


def _write_index(
    source: ExportSource, folder: Path, options: ExportOptions, unit: float, frames: list[dict[str, Any]]
) -> None:
    sensor = source.seen_by(options)
    k = optics_of(sensor)
    index = {
        "width": sensor.width,
        "height": sensor.height,
        "fx": k.fx,
        "fy": k.fy,
        "cx": k.cx,
        "cy": k.cy,
        "distortion": None if k.distortion is None else {"model": k.distortion.model, **k.distortion.named()},
        "axes": "OpenCV: x right, y down, z forward; the centre of the first pixel is (0.5, 0.5)",
        "depth": f"{options.depth} z along the camera's axis in the scene's unit; 0 where there is no surface",
        "depth_png_unit": unit,
        "depth_png": "z = value * depth_png_unit",
        "normal": "unit vector in camera axes, towards the camera; 0 where there is none",
        "normal_png": "component = 2 * value / 65535 - 1",
        "scale": source.scale.known,
        "frames": frames,
    }
    (folder / INDEX).write_text(json.dumps(index, indent=1), "utf-8")


def _name(view: RenderedView) -> str:
    return f"{view.time_s:.9f}"


KIND = ExportKind(
    name="depth",
    title="depth and normal maps: EXR, 16-bit PNG",
    readers="Nuke, Blender, OpenCV, OpenImageIO",
    loses="what is behind the first surface",
    suffix="",
    fill=fill,
    stale=("depth/*", "normal/*", "colour/*"),
)
