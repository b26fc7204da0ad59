"""What changed in a scene from one version to another, as it travels to viewers.

A viewer holds the scene in numbered slots: one Gaussian each, or none. Changes name the slots that are emptied and
those that are filled anew. A message is little-endian: a header, the emptied slots, and then one column of
`SceneChanges` after another, each at a multiple of its element size.
"""

import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spiked.errors import SceneError
from spiked.scene import Scene

__all__ = ["SceneChanges", "SceneMirror", "travelling", "whole_scene"]

_MAGIC = b"SPKC"
"""First bytes of a message."""
_FORMAT = 1
"""Version of this format."""
_HEADER = struct.Struct("<4s9I")
"""Magic, format, and what `SceneChanges` begins with: whole, began, version, level, slots; then the numbers of
channels, of emptied and of filled slots."""
MOST_SLOTS = 50_000_000
"""More is no scene but a damaged header."""
_LARGEST_HALF = 60_000.0
"""Values are stored up to this: near the largest of 16-bit floats."""
LEVEL_SHARES = (1 / 16, 1 / 4, 1)
"""Shares of the splats at each level of detail."""
FINEST = len(LEVEL_SHARES) - 1
"""Level of detail with all splats."""
_KINDS = ("<u4", "<f4", "<f2", "<f2", "i1", "u1")
"""Types of the columns."""


@dataclass(frozen=True, eq=False)
class SceneChanges:
    """The changes from one state of the slots to another; n Gaussians, C colour channels."""

    whole: bool
    """The slots are all empty before."""
    began: int
    """A random number of these slots, by which they are known; 0: nothing follows from them, and what comes next is
    whole."""
    version: int
    """Version of the scene that the slots show afterwards."""
    level: int
    """Level of detail."""
    slots: int
    """Number of slots afterwards."""
    emptied: NDArray[np.uint32]
    """Slots that hold nothing now, [m]."""
    filled: NDArray[np.uint32]
    """Slots of the Gaussians, [n]."""
    means: NDArray[np.float32]
    """World positions, [n, 3]."""
    log_scales: NDArray[np.float16]
    """[n, 3]"""
    colours: NDArray[np.float16]
    """1 is shown as white, [n, C]."""
    quats: NDArray[np.int8]
    """Rotations, wxyz times 127, [n, 4]."""
    opacities: NDArray[np.uint8]
    """Opacity times 255, [n]."""

    def __len__(self) -> int:
        return len(self.filled)

    @property
    def state(self) -> str | None:
        """What the next changes are asked for with; None: with nothing."""
        return f"{self.began}-{self.version}-{self.level}" if self.began else None

    def write(self) -> bytes:
        """The message."""
        state = (int(self.whole), self.began, self.version, self.level, self.slots)
        header = _HEADER.pack(_MAGIC, _FORMAT, *state, self.colours.shape[1], len(self.emptied), len(self))
        columns: list[NDArray[Any]] = [
            self.filled,
            self.means,
            self.log_scales,
            self.colours,
            self.quats,
            self.opacities,
        ]
        body = (column.astype(kind).tobytes() for column, kind in zip(columns, _KINDS, strict=True))
        return header + self.emptied.astype("<u4").tobytes() + b"".join(body)

    @classmethod
    def read(cls, raw: bytes) -> "SceneChanges":
        """Read a message. Raises SceneError for anything else."""
        if len(raw) < _HEADER.size or not raw.startswith(_MAGIC):
            raise SceneError("these are no changes of a scene: the first bytes are not SPKC")
        _, form, whole, began, version, level, slots, channels, emptied, filled = _HEADER.unpack_from(raw)
        if form != _FORMAT:
            raise SceneError(f"these changes of a scene are of format {form}; format {_FORMAT} is read")
        if whole > 1 or slots > MOST_SLOTS or max(emptied, filled) > slots or channels not in (1, 3):
            raise SceneError("the header of these changes of a scene is damaged")
        widths = (0, 0, 3, 3, channels, 4, 0)
        kinds, counts = ("<u4", *_KINDS), (emptied, *(filled for _ in _KINDS))
        found, at = [], _HEADER.size
        for kind, count, width in zip(kinds, counts, widths, strict=True):
            numbers = count * max(width, 1)
            if len(raw) - at < numbers * np.dtype(kind).itemsize:
                raise SceneError(f"the changes of a scene are cut short after {len(raw)} bytes")
            column = np.frombuffer(raw, kind, numbers, at)
            at += column.nbytes
            found.append(column.reshape(count, width) if width else column)
        if at != len(raw):
            raise SceneError(f"{len(raw) - at} bytes follow the changes of a scene")
        gone, slot, means, log_scales, colours, quats, opacities = found
        if max(gone.max(initial=0), slot.max(initial=0)) >= max(slots, 1):
            raise SceneError("these changes of a scene name slots that do not exist")
        columns = (means, log_scales, colours)
        if not all(np.isfinite(column).all() for column in columns):
            raise SceneError("these changes of a scene hold values that are not finite")
        return cls(bool(whole), began, version, level, slots, gone, slot, *columns, quats, opacities)


def whole_scene(scene: Scene, white: float, version: int) -> SceneChanges:
    """All splats of a scene, in slots of their own, at the finest level of detail; radiance `white` is colour 1."""
    slots = np.arange(len(scene), dtype=np.uint32)
    return SceneChanges(True, 0, version, FINEST, len(scene), slots[:0], slots, *travelling(scene, white))


def travelling(scene: Scene, white: float) -> tuple[NDArray[Any], ...]:
    """The splats as they travel: means [n, 3], log_scales [n, 3], colours [n, C], quats [n, 4], opacities [n].

    Radiance `white` is colour 1.
    """
    quats = scene.quats / np.maximum(np.linalg.norm(scene.quats, axis=1, keepdims=True), 1e-12)
    return (
        scene.means,
        np.clip(scene.log_scales, -_LARGEST_HALF, _LARGEST_HALF).astype(np.float16),
        np.clip(scene.colours / np.float32(white or 1), -_LARGEST_HALF, _LARGEST_HALF).astype(np.float16),
        np.round(np.where(quats[:, :1] < 0, -quats, quats) * 127).astype(np.int8),
        np.round(255 / (1 + np.exp(-np.clip(scene.opacity_logits, -30, 30)))).astype(np.uint8),
    )


class SceneMirror:
    """Follows a scene by its changes."""

    def __init__(self) -> None:
        self._slots = _empty_slots(0, 1)
        self._held = np.zeros(0, bool)
        self.state: str | None = None
        """What the next changes are asked for with, as `since`; None: the whole scene is needed."""

    def apply(self, changes: SceneChanges) -> None:
        """Bring the scene up to date. Raises SceneError for changes of another scene."""
        channels = changes.colours.shape[1]
        if changes.whole:
            self._slots, self._held = _empty_slots(changes.slots, channels), np.zeros(changes.slots, bool)
        elif channels != self._slots[-1].shape[1] or changes.slots < len(self._held):
            raise SceneError("these changes are of another scene; ask for the whole")
        more = changes.slots - len(self._held)
        if more:
            self._slots = [np.concatenate(pair) for pair in zip(self._slots, _empty_slots(more, channels), strict=True)]
            self._held = np.concatenate([self._held, np.zeros(more, bool)])
        self._held[changes.emptied] = False
        self._held[changes.filled] = True
        for array, column in zip(self._slots, _values(changes), strict=True):
            array[changes.filled] = column
        self.state = changes.state

    def scene(self, white: float | None = None) -> Scene:
        """The Gaussians in the order of their slots; radiance `white` is that of colour 1."""
        means, quats, log_scales, logits, colours = (array[self._held] for array in self._slots)
        return Scene(means, quats, log_scales, logits, colours * np.float32(white or 1), white)


def _values(changes: SceneChanges) -> tuple[NDArray[Any], ...]:
    """The arrays of a `Scene`; colours are relative to white."""
    opacity = np.clip(changes.opacities / 255, 1 / 1024, 1 - 1 / 1024)
    return changes.means, changes.quats / 127, changes.log_scales, np.log(opacity / (1 - opacity)), changes.colours


def _empty_slots(count: int, channels: int) -> list[NDArray[np.float32]]:
    shapes = ((count, 3), (count, 4), (count, 3), (count,), (count, channels))
    return [np.zeros(shape, np.float32) for shape in shapes]
