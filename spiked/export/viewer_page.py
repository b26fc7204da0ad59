"""One web page that shows the scene: opened from a folder, or from any web server, without a service."""

import base64
import gzip
import hashlib
import html
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from spiked.camera import Pinhole
from spiked.errors import ConfigurationError
from spiked.export.kind import ExportKind
from spiked.export.source import ExportOptions, ExportSource
from spiked.pose import quaternion
from spiked.recon.statistics import evenly
from spiked.scene_changes import whole_scene
from spiked.sensor import Sensor

__all__ = ["KIND"]

SCRIPT = Path(__file__).with_name("viewer.js")
"""Made of web/src/viewer by `make page`."""
_MOST_POSES = 5_000
"""Poses of the path, at most: as many as a screen can show apart."""
_POLICY = (
    "default-src 'none'; script-src 'sha256-{digest}' 'wasm-unsafe-eval'; style-src 'unsafe-inline'; "
    "img-src data: blob:; connect-src data: blob:; worker-src blob:; base-uri 'none'; form-action 'none'"
)
"""The page asks nothing of any network."""
_PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{policy}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
</head>
<body>
<script id="about" type="application/json">{about}</script>
<script id="scene" type="application/octet-stream">{scene}</script>
<script>{script}</script>
</body>
</html>
"""


def _fill(source: ExportSource, path: Path, options: ExportOptions) -> str:
    scene = source.need_scene()
    if not SCRIPT.is_file():
        raise ConfigurationError("the viewer is not built: run make page, or use a release of spiked")
    script = SCRIPT.read_text(encoding="utf-8").replace("</script", "<\\/script")
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    packed = gzip.compress(whole_scene(scene, source.white, 1).write(), mtime=0)
    page = _PAGE.format(
        policy=_POLICY.format(digest=digest),
        title=html.escape(source.title or source.name),
        about=json.dumps(_about(source)).replace("<", "\\u003c"),  # ends no element
        scene=base64.b64encode(packed).decode(),
        script=script,
    )
    path.write_text(page, encoding="utf-8")
    return f"{len(scene)} splats and {len(source.path)} poses in a page"


def _about(source: ExportSource) -> dict[str, Any]:
    """Name, camera and path, as web/src/viewer/content.ts reads them."""
    path, sensor = source.path, source.sensor
    rows = evenly(len(path), _MOST_POSES) if len(path) else []
    rate = 1.0 if sensor is None else sensor.frame_rate_hz
    return {
        "name": source.title or source.name,
        "sensor": _seen_by(sensor),
        "scale": source.scale.known,
        "times_s": path.times_s[rows].tolist(),
        "frames": np.round(path.times_s[rows] * rate - 0.5).astype(int).tolist(),
        "positions": path.centres[rows].tolist(),
        "quaternions_wxyz": [quaternion(path.rotations[row]).tolist() for row in rows],
    }


def _seen_by(sensor: Sensor | None) -> dict[str, Any] | None:
    """The camera as it is drawn: without its lens."""
    if sensor is None or sensor.intrinsics is None:
        return None
    optics = Pinhole.of(replace(sensor.intrinsics, distortion=None))
    assert optics is not None
    return {
        "width": sensor.width,
        "height": sensor.height,
        "frame_rate_hz": sensor.frame_rate_hz,
        "intrinsics": optics.model_dump(mode="json"),
    }


KIND = ExportKind(
    name="viewer",
    title="a web page with a viewer of splats and path, in one file",
    readers="browsers, from a folder or any web server",
    loses="rounding to 16 bits; view-dependent colour; poses beyond 5000",
    suffix=".html",
    fill=_fill,
    media_type="text/html",
    titled=True,
)
