"""SPZ, the compressed scene format of Niantic, versions 2 and 3: https://github.com/nianticlabs/spz.

A gzip stream of a 16-byte header and then one array after another: positions, opacities, colours, scales, rotations.
SPZ keeps its scene with RUB axes (x right, y up, z back); ours, and those of a PLY, are RDF (x right, y down, z
forward): positions and rotations are turned by 180 degrees about x, which is its own inverse.

What is stored is rounded, and no further from the scene than these bounds (`tests/test_spz.py` holds them):
positions `position_step(scene) / 2`; opacities 1/510; logarithms of scales 1/32, and only -10 to 5.94 can be stored;
colours 0.5 / 255 / 0.15 * C0 = 0.0037 of white, and only -0.44 to 1.44 of white can be stored; rotations 0.3 degrees
(version 3), or 0.8 degrees divided by the cosine of half their angle (version 2); coefficients of view-dependent colour
1/256 of white, and only -1 to 0.99 of white can be stored.
"""

import gzip
import struct
import zlib
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from spiked.errors import SceneError
from spiked.harmonics import COEFFICIENTS, rotated_harmonics
from spiked.scene import SH_C0, Array, Scene

__all__ = ["SpzVersion", "decode", "encode", "fractional_bits", "position_step"]

Bytes = NDArray[np.uint8]

_MAGIC = 0x5053474E
"""First word of a file: NGSP."""
_HEADER = struct.Struct("<IIIBBBB")  # magic, version, number of points, degree of SH, fractional bits, flags, reserved
_COLOUR_SCALE = 0.15
"""Scale of the constant colour coefficient in a byte, of the SPZ format."""
_LARGEST = (1 << 23) - 1
"""Positions are signed 24-bit fixed-point numbers."""
_FINEST_BITS = 22
"""Most bits after the point."""
_MAGNITUDES = (1 << 9) - 1
"""Largest number of 9 bits: a component of a quaternion in version 3."""
_SQRT_HALF = np.float32(np.sqrt(0.5))
_TO_RUB = np.array([1, -1, -1], np.float32)
_SH_COEFFICIENTS = (0, 3, 8, 15, 24)
"""Beyond the constant one, by degree."""
_HARMONIC_STEPS = 128
"""Steps of a byte for a coefficient of 1."""
_HALF_TURN = np.diag([1.0, -1.0, -1.0])
"""Between RDF and RUB axes."""
MAX_POINTS = 10_000_000
"""As in Niantic's own reader."""


class SpzVersion(IntEnum):
    """How rotations are packed: three bytes, or the more exact four of smallest-three."""

    V2 = 2
    V3 = 3


def fractional_bits(means: Array) -> int:
    """Bits after the point, as many as leave room for the largest coordinate of means [N, 3]. Raises SceneError."""
    reach = float(np.abs(means).max(initial=0.0))
    if not reach < _LARGEST:
        raise SceneError(f"a scene that reaches {reach:g} does not fit into SPZ's 24-bit positions; use PLY")
    bits = _FINEST_BITS
    while round(reach * 2.0**bits) > _LARGEST:
        bits -= 1
    return bits


def position_step(scene: Scene) -> float:
    """Distance between neighbouring coordinates in the file, in the scene's unit of length."""
    return float(2.0 ** -fractional_bits(scene.means))


def encode(scene: Scene, white: float = 1.0, version: SpzVersion = SpzVersion.V3) -> bytes:
    """The bytes of an SPZ file; radiance `white` becomes colour 1. Raises SceneError for a scene that does not fit."""
    if len(scene) > MAX_POINTS:
        raise SceneError(f"{len(scene)} Gaussians are more than the {MAX_POINTS} of an SPZ file; use PLY")
    bits = fractional_bits(scene.means)
    header = _HEADER.pack(_MAGIC, version, len(scene), scene.degree, bits, 0, 0)
    coordinates = np.round((scene.means * _TO_RUB).astype(np.float64) * 2.0**bits).astype("<i4")
    positions = coordinates.reshape(-1, 1).view(np.uint8)[:, :3]
    dc = (np.broadcast_to(scene.colours, (len(scene), 3)) / white - 0.5) / SH_C0
    quats = _turned(scene.quats / np.maximum(np.linalg.norm(scene.quats, axis=1, keepdims=True), 1e-12))
    parts = [
        positions,
        _bytes(scene.opacities * 255),
        _bytes((dc * _COLOUR_SCALE + 0.5) * 255),
        _bytes((scene.log_scales + 10) * 16),
        _first_three(quats) if version is SpzVersion.V2 else _smallest_three(quats),
        _bytes(_harmonics(scene) / white * _HARMONIC_STEPS + _HARMONIC_STEPS),
    ]
    # Level 6 of zlib is within 1 % of the size of level 9 for these bytes, and several times as fast.
    return gzip.compress(header + b"".join(part.tobytes() for part in parts), compresslevel=6, mtime=0)


def decode(raw: bytes, white: float = 1.0) -> Scene:
    """The scene of an SPZ file of version 2 or 3, with radiance `white` for colour 1; equal red, green and blue read as
    one channel.

    Raises SceneError for anything that is no such file, one cut short, and one that grows beyond what its header says.
    """
    header, body = _inflate(raw)
    magic, version, count, degree, bits, _, _ = header
    if magic != _MAGIC:
        raise SceneError("this is a gzip file, but not an SPZ scene: its first bytes are not NGSP")
    if version not in tuple(SpzVersion):
        raise SceneError(f"this SPZ is of version {version}; versions 2 and 3 are read")
    widths = (9, 1, 3, 3, 3 if version == SpzVersion.V2 else 4, 3 * _SH_COEFFICIENTS[degree])
    ends = np.cumsum([0, *(count * width for width in widths)])
    means, alphas, colours, scales, rotations, rest = (
        np.frombuffer(body, np.uint8, count * width, int(start)).reshape(count, width)
        for width, start in zip(widths, ends[:-1], strict=True)
    )
    fixed = np.zeros((count * 3, 4), np.uint8)
    fixed[:, 1:] = means.reshape(-1, 3)
    coordinates = fixed.view("<i4")[:, 0] >> 8  # the shift carries the sign down
    opacity = np.clip(alphas[:, 0] / 255, 1 / 510, 1 - 1 / 510)  # 0 and 1 have no finite logit: half a step inside
    rgb = (0.5 + SH_C0 * (colours / np.float32(255) - 0.5) / _COLOUR_SCALE) * white
    quats = _from_first_three(rotations) if version == SpzVersion.V2 else _from_smallest_three(rotations)
    kept = COEFFICIENTS[min(degree, len(COEFFICIENTS) - 1)]  # a fourth degree is left out
    steps = rest.reshape(count, _SH_COEFFICIENTS[degree], 3)[:, :kept]
    harmonics = np.asarray((steps / np.float32(_HARMONIC_STEPS) - 1) * white, np.float32)
    grey = bool(np.all(rgb == rgb[:, :1])) and bool(np.all(steps == steps[..., :1]))
    harmonics = rotated_harmonics(harmonics[..., :1] if grey else harmonics, _HALF_TURN)
    return Scene(
        (coordinates.reshape(count, 3) * 2.0**-bits).astype(np.float32) * _TO_RUB,
        _turned(quats),
        (scales / np.float32(16) - np.float32(10)).astype(np.float32),
        np.log(opacity / (1 - opacity)).astype(np.float32),
        np.ascontiguousarray(rgb[:, :1] if grey else rgb, np.float32),
        harmonics=harmonics if kept else None,
    )


def _inflate(raw: bytes) -> tuple[tuple[int, ...], bytes]:
    """Header and arrays, never more bytes than the header announces."""
    stream = zlib.decompressobj(wbits=31)
    try:
        head = stream.decompress(raw, _HEADER.size)
        if len(head) < _HEADER.size:
            raise SceneError("this is not an SPZ scene: it ends within its header")
        header = _HEADER.unpack(head)
        _, version, count, degree, bits, _, _ = header
        if count > MAX_POINTS or degree >= len(_SH_COEFFICIENTS) or bits > 24:
            raise SceneError(
                f"this is not an SPZ scene that can be read: {count} Gaussians, degree {degree}, {bits} bits"
            )
        need = count * (19 + (version == SpzVersion.V3) + 3 * _SH_COEFFICIENTS[degree])
        body = stream.decompress(stream.unconsumed_tail, need) if need else b""
    except zlib.error as error:
        raise SceneError(f"this is not an SPZ scene: {error}") from error
    if len(body) < need:
        raise SceneError(f"this SPZ is cut short: {count} Gaussians need {need} bytes, {len(body)} are there")
    return header, body


def _harmonics(scene: Scene) -> NDArray[np.floating]:
    """Coefficients in RUB axes, of three channels, [N, 3 K]."""
    if scene.harmonics is None:
        return np.zeros((len(scene), 0), np.float32)
    turned = rotated_harmonics(scene.harmonics, _HALF_TURN)
    return np.broadcast_to(turned, (*turned.shape[:2], 3)).reshape(len(scene), -1)


def _bytes(values: NDArray[np.floating]) -> Bytes:
    return np.clip(np.round(values), 0, 255).astype(np.uint8)


def _turned(quats: Array) -> Array:
    """Quaternions wxyz [N, 4] between RDF and RUB axes: the 180 degrees about x conjugate them."""
    return quats * np.array([1, 1, -1, -1], np.float32)


def _first_three(quats: Array) -> Bytes:
    """x, y, z of unit quaternions wxyz with w >= 0, a byte each."""
    xyz = quats[:, 1:] * np.where(quats[:, :1] < 0, -1, 1)
    return _bytes(xyz * 127.5 + 127.5)


def _from_first_three(packed: Bytes) -> Array:
    xyz = packed / np.float32(127.5) - np.float32(1)
    w = np.sqrt(np.maximum(0, 1 - (xyz**2).sum(1, keepdims=True)))
    return np.concatenate([w, xyz], 1).astype(np.float32)


def _smallest_three(quats: Array) -> Bytes:
    """The index of the largest component of xyzw in the upper two bits, then the others, sign and 9 bits each."""
    xyzw = quats[:, [1, 2, 3, 0]]
    largest = np.abs(xyzw).argmax(1)
    xyzw = xyzw * np.where(np.take_along_axis(xyzw, largest[:, None], 1) < 0, -1, 1)
    magnitude = np.floor(_MAGNITUDES * np.abs(xyzw) / _SQRT_HALF + 0.5).astype(np.uint32)
    part = np.minimum(magnitude, _MAGNITUDES) | (xyzw < 0).astype(np.uint32) << 9
    word = largest.astype(np.uint32)
    for i in range(4):
        word = np.where(largest == i, word, word << 10 | part[:, i])
    packed: Bytes = word.astype("<u4")[:, None].view(np.uint8)
    return packed


def _from_smallest_three(packed: Bytes) -> Array:
    word = np.ascontiguousarray(packed).view("<u4")[:, 0].copy()
    largest = word >> 30
    xyzw = np.zeros((len(word), 4), np.float32)
    for i in (3, 2, 1, 0):
        here = largest != i
        value = (word & _MAGNITUDES) * (_SQRT_HALF / _MAGNITUDES) * np.where(word >> 9 & 1, np.float32(-1), 1)
        xyzw[here, i] = value[here]
        word = np.where(here, word >> 10, word)
    rest = np.sqrt(np.maximum(0, 1 - (xyzw**2).sum(1)))
    np.put_along_axis(xyzw, largest.astype(np.int64)[:, None], rest[:, None], 1)
    return xyzw[:, [3, 0, 1, 2]]
