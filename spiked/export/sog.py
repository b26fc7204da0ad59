"""SOG of PlayCanvas, version 2: https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog.

A ZIP of meta.json and lossless WebP images; pixel i of each image belongs to splat i. Positions are 16 bits between
the ends of sign(x) log(1 + |x|); scales and colours are places in lists of 256 values; a rotation is its three smaller
components and the index of the largest; opacity is a byte. Axes are those of the PLY.
"""

import io
import json
import zipfile
from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from spiked.errors import SceneError
from spiked.export.compressed_ply import morton_order, unit_with_largest
from spiked.scene import SH_C0, Scene

__all__ = ["encode"]

CODES = 256
"""Values of a list."""
SAMPLE = 200_000
"""Values that a list is fitted to, at most."""
ROUNDS = 10
"""Steps of Lloyd's method, which fits a list."""
_TIME = (1980, 1, 1, 0, 0, 0)
"""Of the files in the archive: the same scene gives the same bytes."""
Bytes = NDArray[np.uint8]
Floats = NDArray[np.float32]


def encode(scene: Scene, white: float = 1.0, about: Mapping[str, Any] | None = None) -> bytes:
    """The bytes of the file; radiance `white` becomes colour 1, `about` stands in `asset` of meta.json.

    Raises SceneError for a scene without splats.
    """
    if not len(scene):
        raise SceneError("a scene without splats cannot be written as SOG; use PLY")
    scene = scene.select(morton_order(scene.means))
    dc = ((np.broadcast_to(scene.colours, (len(scene), 3)) / white - 0.5) / SH_C0).astype(np.float32)
    low, high, ends = _positions(scene.means)
    scale_codes, scales = _coded(scene.log_scales)
    colour_codes, colours = _coded(dc)
    opacity = np.rint(255 / (1 + np.exp(-scene.opacity_logits.astype(np.float64)))).astype(np.uint8)
    images = {
        "means_l.webp": low,
        "means_u.webp": high,
        "scales.webp": scales,
        "quats.webp": _rotations(scene.quats),
        "sh0.webp": np.concatenate([colours, opacity[:, None]], 1),
    }
    meta = {
        "version": 2,
        "asset": {"generator": "spiked", **(about or {})},
        "count": len(scene),
        "means": {"mins": ends[0].tolist(), "maxs": ends[1].tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": scale_codes.tolist(), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": colour_codes.tolist(), "files": ["sh0.webp"]},
    }
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as file:
        file.writestr(zipfile.ZipInfo("meta.json", _TIME), json.dumps(meta))
        for name, values in images.items():
            file.writestr(zipfile.ZipInfo(name, _TIME), _webp(values))
    return archive.getvalue()


def _positions(means: Floats) -> tuple[Bytes, Bytes, NDArray[np.float64]]:
    """Lower and upper bytes [n, 3], and the ends [2, 3] of what they stand for."""
    logs = np.sign(means) * np.log1p(np.abs(means.astype(np.float64)))
    low, high = logs.min(0), logs.max(0)
    level = np.rint(65535 * (logs - low) / np.where(high > low, high - low, 1)).astype(np.uint16)
    return (level & 255).astype(np.uint8), (level >> 8).astype(np.uint8), np.stack([low, high])


def _coded(values: Floats) -> tuple[NDArray[np.float64], Bytes]:
    """A list of 256 values in rising order, and the place of the nearest for each of [n, 3]."""
    flat = np.sort(values[:: max(1, values.size // SAMPLE)].ravel().astype(np.float64))
    codes = flat[np.linspace(0, len(flat) - 1, CODES).astype(int)]
    sums = np.concatenate([[0.0], np.cumsum(flat)])
    for _ in range(ROUNDS):
        ends = np.concatenate([[0], np.searchsorted(flat, (codes[1:] + codes[:-1]) / 2), [len(flat)]])
        count = np.diff(ends)
        codes = np.sort(np.where(count > 0, (sums[ends[1:]] - sums[ends[:-1]]) / np.maximum(count, 1), codes))
    return codes, np.searchsorted((codes[1:] + codes[:-1]) / 2, values).astype(np.uint8)


def _rotations(quats: Floats) -> Bytes:
    """Three components of wxyz without the largest, and 252 plus its index, [n, 4]."""
    unit, largest = unit_with_largest(quats)
    others = np.stack([np.delete(np.arange(4), one) for one in range(4)])[largest]
    parts = np.take_along_axis(unit, others, 1) * np.sqrt(0.5) + 0.5
    return np.concatenate([np.rint(parts * 255), 252.0 + largest[:, None]], 1).astype(np.uint8)


def _webp(values: Bytes) -> bytes:
    """A lossless image of rows [n, 3] or [n, 4], four splats more than a square at most."""
    side = int(np.ceil(np.sqrt(len(values)) / 4) * 4)
    height = -(-len(values) // side)
    pixels = np.full((height * side, 4), 255, np.uint8)
    pixels[len(values) :] = 0
    pixels[: len(values), : values.shape[1]] = values
    image = pixels.reshape(height, side, 4)[..., [2, 1, 0, 3]]
    done, encoded = cv2.imencode(".webp", image, [cv2.IMWRITE_WEBP_QUALITY, 101])
    if not done:
        raise SceneError("this OpenCV cannot write WebP images, which SOG is made of")
    return encoded.tobytes()
