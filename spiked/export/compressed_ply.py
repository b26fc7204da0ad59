"""Compressed PLY of PlayCanvas: https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/ply.

Splats in groups of 256 that lie near one another; a group has the ranges of its positions, scales and colours, and a
splat four 32-bit numbers: position 11-10-11 bits, rotation 2-10-10-10, scale 11-10-11, colour and opacity 8-8-8-8, and
a byte for each coefficient of view-dependent colour, from -4 to 4.
"""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from spiked.harmonics import COEFFICIENTS
from spiked.ply_header import ply_header
from spiked.scene import SH_C0, Scene, unit_quats

__all__ = ["encode", "morton_order"]

GROUP = 256
"""Splats of a group."""
SMALLEST, LARGEST = -20.0, 20.0
"""Logarithms of scales that are kept."""
OPACITIES = (1 / 255, 254 / 255)
"""Opacities that are kept: readers that go back to logits make infinities of 0 and 1."""
HARMONIC_RANGE = 8.0
"""Between the smallest and the largest coefficient of view-dependent colour, white being 1."""
_RANGES = ("x", "y", "z", "scale_x", "scale_y", "scale_z", "r", "g", "b")
Words = NDArray[np.uint32]
Floats = NDArray[np.float32]


def encode(scene: Scene, white: float = 1.0, notes: Iterable[str] = ()) -> bytes:
    """The bytes of the file; radiance `white` becomes colour 1, `notes` become comments."""
    scene = scene.select(morton_order(scene.means))
    count, groups = len(scene), -(-len(scene) // GROUP)
    dc = (np.broadcast_to(scene.colours, (count, 3)) / white - 0.5) / SH_C0
    values = [scene.means, scene.log_scales.clip(SMALLEST, LARGEST), (dc * SH_C0 + 0.5).astype(np.float32)]
    ranges, parts = [], []
    for value in values:
        low, high, part = _in_groups(value, groups)
        ranges.append((low, high))
        parts.append(part)
    opacity = scene.opacities.clip(*OPACITIES)
    table = np.stack(
        [
            _packed_11_10_11(parts[0]),
            _packed_rotation(scene.quats),
            _packed_11_10_11(parts[1]),
            _packed_colour(np.concatenate([parts[2], opacity[:, None]], 1)),
        ],
        1,
    )
    chunks = np.concatenate([side for low, high in ranges for side in (low, high)], 1)
    rest = _harmonics(scene, white)
    body = chunks.astype("<f4").tobytes() + table.astype("<u4").tobytes() + rest.tobytes()
    return _header(groups, count, rest.shape[1], notes) + body


def _harmonics(scene: Scene, white: float) -> NDArray[np.uint8]:
    """Coefficients, all of a channel before those of the next, [n, 3 K]."""
    rest = scene.filled_harmonics(COEFFICIENTS[scene.degree]) / white
    rest = np.broadcast_to(rest, (*rest.shape[:2], 3)).swapaxes(1, 2).reshape(len(scene), 3 * rest.shape[1])
    return np.asarray(np.clip((rest / HARMONIC_RANGE + 0.5) * 256, 0, 255), np.uint8)


def _header(groups: int, count: int, rest: int, notes: Iterable[str]) -> bytes:
    names = [f"{side}_{name}" for first in (0, 3, 6) for side in ("min", "max") for name in _RANGES[first : first + 3]]
    packed = [f"uint packed_{name}" for name in ("position", "rotation", "scale", "color")]
    elements = [("chunk", groups, [f"float {name}" for name in names]), ("vertex", count, packed)]
    if rest:
        elements.append(("sh", count, [f"uchar f_rest_{number}" for number in range(rest)]))
    return ply_header(elements, notes)


def _in_groups(values: Floats, groups: int) -> tuple[Floats, Floats, NDArray[np.float64]]:
    """Smallest and largest values of each group, [groups, 3], and the values from 0 to 1 between them, [n, 3]."""
    padded = np.pad(values, ((0, groups * GROUP - len(values)), (0, 0)), "edge") if groups else values
    blocks = padded.reshape(groups, GROUP, 3)
    low, high = blocks.min(1), blocks.max(1)
    span = np.where(high > low, high - low, 1)
    share = ((blocks - low[:, None]) / span[:, None]).reshape(-1, 3)[: len(values)]
    return low, high, share.astype(np.float64)


def _levels(share: NDArray[np.float64], bits: int) -> Words:
    most = (1 << bits) - 1
    return np.clip(np.floor(share * most + 0.5), 0, most).astype(np.uint32)


def _packed_11_10_11(share: NDArray[np.float64]) -> Words:
    return np.asarray(
        _levels(share[:, 0], 11) << 21 | _levels(share[:, 1], 10) << 11 | _levels(share[:, 2], 11), np.uint32
    )


def _packed_colour(share: NDArray[np.float64]) -> Words:
    red, green, blue, alpha = _levels(share, 8).T
    return np.asarray(red << 24 | green << 16 | blue << 8 | alpha, np.uint32)


def _packed_rotation(quats: Floats) -> Words:
    """Index of the largest component of wxyz, then the others times the root of 1/2, from 0 to 1."""
    unit, largest = unit_with_largest(quats)
    word = largest.astype(np.uint32)
    for part in range(4):
        level = _levels(unit[:, part] * np.sqrt(0.5) + 0.5, 10)
        word = np.where(largest == part, word, word << 10 | level)
    return np.asarray(word, np.uint32)


def unit_with_largest(quats: Floats) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Unit quaternions [n, 4] whose largest component is positive, and the index of it, [n]; 0 counts as 1, 0, 0, 0."""
    unit = unit_quats(quats)
    largest = np.abs(unit).argmax(1)
    unit *= np.where(np.take_along_axis(unit, largest[:, None], 1) < 0, -1, 1)
    return unit, largest


def morton_order(means: Floats) -> NDArray[np.int64]:
    """Rows [n] of positions [n, 3] along a Morton curve of 1,024 cells a side: neighbours in it are near in space."""
    if not len(means):
        return np.zeros(0, np.int64)
    low, high = means.min(0), means.max(0)
    cells = ((means - low) / np.maximum(high - low, 1e-12) * 1023).astype(np.uint32)
    key = np.zeros(len(means), np.uint32)
    for bit in range(10):
        for axis in range(3):
            key |= (cells[:, axis] >> bit & 1) << (3 * bit + axis)
    return np.argsort(key, kind="stable").astype(np.int64)
