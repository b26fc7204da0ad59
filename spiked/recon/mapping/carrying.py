"""Splats that keep their places in the views they were seeded from when the path is corrected."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spiked.pose import Array, log_so3, quaternion, rotation_of
from spiked.scene import Scene, unit_quats


@dataclass(frozen=True)
class Places:
    """Where n views are, and how large their surroundings."""

    rotations: Array
    """[n, 3, 3], camera to world."""
    centres: Array
    """[n, 3]"""
    scales: Array
    """[n], lengths around each view over those when it got its pose."""

    @classmethod
    def none(cls) -> "Places":
        """No views."""
        return cls(np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros(0))

    def __len__(self) -> int:
        return len(self.scales)

    def __getitem__(self, rows: NDArray[np.int64] | NDArray[np.bool_]) -> "Places":
        return Places(self.rotations[rows], self.centres[rows], self.scales[rows])

    def joined(self, others: "Places") -> "Places":
        """These and others after them."""
        pairs = ((self.rotations, others.rotations), (self.centres, others.centres), (self.scales, others.scales))
        return Places(*(np.concatenate(pair) for pair in pairs))

    def replaced(self, rows: NDArray[np.bool_], others: "Places") -> "Places":
        """These with those of `others` [n] at `rows` [n]."""
        return Places(
            np.where(rows[:, None, None], others.rotations, self.rotations),
            np.where(rows[:, None], others.centres, self.centres),
            np.where(rows, others.scales, self.scales),
        )

    def moved_px(self, after: "Places", focal_px: float, depth: float) -> Array:
        """About how far [n] points at a depth move in the images, if the views move and the points do not."""
        turns = log_so3(after.rotations @ self.rotations.swapaxes(1, 2))
        ways = (after.centres - self.centres) / depth
        grown = np.abs(np.log(after.scales / self.scales))
        return np.asarray(focal_px * (np.linalg.norm(turns, axis=1) + np.linalg.norm(ways, axis=1) + grown))


def carried(scene: Scene, rows: NDArray[np.int64], before: Places, after: Places) -> Scene:
    """The scene with its splats at `rows` [n] moved, each as its place [n] has."""
    turns = after.rotations @ before.rotations.swapaxes(1, 2)
    scales = after.scales / before.scales
    means, quats, log_scales = (array.copy() for array in (scene.means, scene.quats, scene.log_scales))
    offsets = scales[:, None] * (means[rows] - before.centres)
    means[rows] = after.centres + np.einsum("nij,nj->ni", turns, offsets)
    quats[rows] = quaternion(turns @ rotation_of(unit_quats(quats[rows])))
    log_scales[rows] += np.log(scales)[:, None].astype(np.float32)
    return Scene(means, quats, log_scales, scene.opacity_logits, scene.colours, scene.white)


class Homes:
    """The views that splats were seeded from."""

    def __init__(self, splats: int = 0) -> None:
        """Of so many splats without one."""
        self.times: list[float] = []
        """When these views were, in frames; one may occur again."""
        self.places = Places.none()
        """Where they were when their splats were seeded or carried."""
        self._rows = np.full(splats, -1)
        """[N], which of them each splat has; -1 for none."""

    def add(self, splats: int, time: float | None) -> None:
        """Splats were seeded from the view at a time; None for none."""
        if time is not None and time not in self.times[-1:]:
            self.times.append(time)
        self._rows = np.append(self._rows, np.full(splats, -1 if time is None else len(self.times) - 1))

    def select(self, splats: NDArray[np.bool_]) -> None:
        """Splats [N] were removed, but for these."""
        self._rows = self._rows[splats]

    def note(self, places: Places) -> None:
        """Where all of them are; those that were noted before have not moved since."""
        self.places = self.places.joined(places[np.arange(len(self.places), len(places))])

    def splats(self, chosen: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Splats [N] of the `chosen` homes."""
        return np.asarray(np.append(chosen, False)[self._rows])  # -1: the last one

    def carry(self, scene: Scene, chosen: NDArray[np.bool_], places: Places) -> Scene:
        """The scene with the splats of the `chosen` homes moved to where all of them are now."""
        rows = np.flatnonzero(self.splats(chosen))
        home = self._rows[rows]
        moved = carried(scene, rows, self.places[home], places[home])
        self.places = self.places.replaced(chosen, places)
        return moved
