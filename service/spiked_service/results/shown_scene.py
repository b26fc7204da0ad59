"""The scene as viewers hold it, in slots, each with the version that changed it last: so any viewer gets what it lacks.

Every splat moves a little in every step of the fit. A slot keeps what it shows until the difference could be seen, so
that between two versions only what has visibly changed travels; see docs/decisions/0020-scenes-travel-as-changes.md.
"""

import io
import secrets
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from spiked.errors import SceneError
from spiked.scene import Scene
from spiked.scene_changes import FINEST, LEVEL_SHARES, SceneChanges, travelling

TOLERANCE = 0.03
"""Difference of a splat, as a share of white at its centre, that is not sent; 0 sends every difference. Of 0.01, 0.03
and 0.06, the largest with which the shown scene stays within 45 dB of the true one (decision 20)."""
_DARKEST = 0.3
"""Brightness, share of white, that moving or hiding splats count with at least: dark ones hide bright ones."""
_SAMPLED = 16
"""Every so many splats one is looked up by its place, which costs more than all other steps."""
_COLUMNS = ("mean", "log_scale", "colour", "quat", "opacity")
"""What travels of a slot, in the order of `SceneChanges`."""

Array = NDArray[np.float32]
Rows = NDArray[Any]


class ShownScene:
    """The slots: what each holds, if anything, and the version that changed it last."""

    def __init__(self) -> None:
        self.began = 0
        """A random number drawn when these slots began: other slots, of another reconstruction or of a backup that was
        restored, have another one. 0: they are of one version only."""
        self.version = 0
        """Version of the scene that they show."""
        self._slots = np.zeros(0, _row_type(1))
        self._slot_of_row = np.zeros(0, np.int64)
        """Slots of the splats of the last version, in its order."""

    @classmethod
    def read(cls, path: Path, began: int, version: int) -> "ShownScene":
        """Read what `write` wrote. Raises SceneError."""
        try:
            slots = np.load(path, allow_pickle=False)
        except (OSError, ValueError, EOFError) as error:
            raise SceneError(f"cannot read {path.name}: {error}") from error
        if slots.ndim != 1 or slots.dtype not in (_row_type(1), _row_type(3)):
            raise SceneError(f"{path.name} has another format")
        shown = cls()
        shown.began, shown.version, shown._slots = began, version, slots
        return shown

    @classmethod
    def of(cls, scene: Scene, white: float, version: int) -> "ShownScene":
        """The slots of one version, which no other continues."""
        shown = cls()
        shown.update(scene, white, version)
        shown.began = 0
        return shown

    def write(self, path: Path) -> None:
        """Write the slots; they can be made anew from the scene, so this does not wait for the disk. Raises OSError."""
        buffer = io.BytesIO()
        np.save(buffer, self._slots)
        part = path.with_name(path.name + ".part")
        part.write_bytes(buffer.getbuffer())
        part.replace(path)

    def update(self, scene: Scene, white: float, version: int, tolerance: float = TOLERANCE) -> None:
        """Make the slots show a version of the scene, within `tolerance`."""
        rows = _rows(scene, white, version)
        if self.began == 0 or self._slots.dtype != rows.dtype:
            self.began, self._slots, self._slot_of_row = _number(), np.zeros(0, rows.dtype), np.zeros(0, np.int64)
        slot_of_row = self._matches(rows, tolerance)
        empty = np.ones(len(self._slots), bool)
        empty[slot_of_row[slot_of_row >= 0]] = False
        self._slots["changed"][empty & self._slots["held"]] = version
        self._slots["held"][empty] = False
        new, free = np.flatnonzero(slot_of_row < 0), np.flatnonzero(empty)
        grown = max(len(new) - len(free), 0)
        slot_of_row[new] = np.concatenate([free, len(self._slots) + np.arange(grown)])[: len(new)]
        self._slots = np.concatenate([self._slots, np.zeros(grown, rows.dtype)])
        self._slots[slot_of_row[new]] = rows[new]
        self._slot_of_row, self.version = slot_of_row, version

    def _matches(self, rows: Rows, tolerance: float) -> NDArray[np.int64]:
        """For each row the slot that shows the same within the tolerance, each slot once; -1: none does.

        Splats keep their order in long runs: some are removed, others come to the end. Where a run lies is found by the
        nearest neighbours of every `_SAMPLED`-th splat.
        """
        slots, before = self._slots, self._slot_of_row
        found = np.full(len(rows), -1, np.int64)
        if not len(before) or not len(rows):
            return found
        sampled = np.arange(0, len(rows), _SAMPLED)
        tree = scipy.spatial.cKDTree(slots["mean"][before], balanced_tree=False, compact_nodes=False)
        offsets = tree.query(rows["mean"][sampled])[1] - sampled
        for run in (offsets, np.append(offsets[1:], offsets[-1])):
            left = np.flatnonzero(found < 0)
            row_before = left + run[left // _SAMPLED]
            left = left[(row_before >= 0) & (row_before < len(before))]
            slot = before[left + run[left // _SAMPLED]]
            near = _difference(slots[slot], rows[left]) <= tolerance
            free = ~np.isin(slot, found)
            unique, first = np.unique(slot[near & free], return_index=True)
            found[left[near & free][first]] = unique
        return found

    def since(self, version: int | None, level: int = FINEST) -> SceneChanges:
        """What changed after a version in the slots of a level of detail; None: all of them."""
        slots, held = self._slots, self._slots["held"]
        # Multiples of the golden ratio spread evenly, and neighbouring slots are neighbours in the scene.
        lot = (np.arange(len(slots), dtype=np.uint64) * np.uint64(2654435769)) & np.uint64(0xFFFFFFFF)
        wanted = (lot < LEVEL_SHARES[level] * 2**32) & (slots["changed"] > (version or 0))
        filled, gone = np.flatnonzero(wanted & held), np.flatnonzero(wanted & ~held & (version is not None))
        columns = (np.ascontiguousarray(slots[name][filled]) for name in _COLUMNS)
        numbers = gone.astype(np.uint32), filled.astype(np.uint32)
        return SceneChanges(version is None, self.began, self.version, level, len(slots), *numbers, *columns)


def _number() -> int:
    """A 32-bit number other than 0."""
    return 1 + secrets.randbelow(0xFFFF_FFFF)


def _row_type(channels: int) -> np.dtype[Any]:
    return np.dtype(
        [
            ("mean", "<f4", 3),
            ("log_scale", "<f2", 3),
            ("colour", "<f2", (channels,)),
            ("quat", "i1", 4),
            ("opacity", "u1"),
            ("held", "?"),
            ("changed", "<u4"),
        ]
    )


def _rows(scene: Scene, white: float, version: int) -> Rows:
    """The splats as they travel; colour 1 is radiance `white`."""
    rows = np.zeros(len(scene), _row_type(scene.colours.shape[1]))
    for name, column in zip(_COLUMNS, travelling(scene, white), strict=True):
        rows[name] = column
    rows["held"], rows["changed"] = True, version
    return rows


def _difference(shown: Rows, rows: Rows) -> Array:
    """About the largest difference that showing one splat for the other makes, as a share of white, [n]."""
    alpha = np.float32(np.maximum(shown["opacity"], rows["opacity"])) / 255
    before, after = np.float32(shown["colour"]), np.float32(rows["colour"])
    brightness = np.maximum(np.maximum(before, after).max(1), _DARKEST)
    log_scales = np.float32(rows["log_scale"])
    middle, largest = np.sort(log_scales, 1)[:, 1], log_scales.max(1)
    moved = np.linalg.norm(rows["mean"] - shown["mean"], axis=1) * np.exp(-middle)
    grown = np.abs(log_scales - shown["log_scale"]).max(1)
    one, other = np.float32(shown["quat"]), np.float32(rows["quat"])
    cosine = np.abs((one * other).sum(1)) / np.maximum(np.linalg.norm(one, axis=1) * np.linalg.norm(other, axis=1), 1)
    angle = np.where((one == other).all(1), 0, 2 * np.arccos(np.clip(cosine, 0, 1)))
    # A Gaussian falls most steeply by 0.6 of its height a deviation, and 10 times longer ones count as lines.
    shape = 0.6 * moved + 0.5 * grown + 0.3 * angle * np.minimum(np.exp(largest - middle), 10)
    opacity = np.abs(np.float32(shown["opacity"]) - rows["opacity"]) / 255
    return np.asarray(alpha * (np.abs(before - after).max(1) + brightness * shape) + opacity * brightness, np.float32)
