"""Moves a map that is distorted along its way: each part of the way by a similarity of its own."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spiked.evaluate import Similarity
from spiked.harmonics import rotated_harmonics
from spiked.pose import Array, exp_so3, log_so3, quaternion
from spiked.recon.merging.known_map import brightened, turned_quaternions
from spiked.scene import Scene
from spiked.trajectory import Trajectory


@dataclass(frozen=True)
class PathWarp:
    """A similarity for each of some moments of a way; between two moments their blend, outside those of the ends."""

    times: Array
    """[m], increasing."""
    similarities: Sequence[Similarity]
    """From the map's frame of reference to the new one."""

    def poses(self, times: Array, rotations: Array, centres: Array) -> tuple[Array, Array]:
        """Camera-to-world poses at times [n], moved."""
        right = np.clip(np.searchsorted(self.times, times), 1, max(len(self.times) - 1, 1))
        left = right - 1
        right = np.minimum(right, len(self.times) - 1)
        span = self.times[right] - self.times[left]
        share = np.clip((times - self.times[left]) / np.where(span > 0, span, 1), 0, 1)
        turns = np.stack([one.rotation for one in self.similarities])
        between = log_so3(turns[left].swapaxes(1, 2) @ turns[right])
        turn = turns[left] @ exp_so3(share[:, None] * between)
        moved = np.stack([one.points(centres) for one in self.similarities])
        rows = np.arange(len(times))
        return turn @ rotations, moved[left, rows] + share[:, None] * (moved[right, rows] - moved[left, rows])

    def path(self, path: Trajectory) -> Trajectory:
        """A trajectory, moved."""
        return Trajectory(path.times_s, *self.poses(path.times_s, path.rotations, path.centres))

    def at(self, time: float) -> Similarity:
        """The similarity at a moment."""
        rotation, centre = self.poses(np.array([time]), np.eye(3)[None], np.zeros((1, 3)))
        scale = np.interp(time, self.times, [np.log(one.scale) for one in self.similarities])
        return Similarity(float(np.exp(scale)), rotation[0], centre[0])

    def scene(self, scene: Scene, weights: NDArray[np.float32], times: Array, brightness: float) -> Scene:
        """A copy of a scene, moved, its radiance multiplied by `brightness`.

        weights [n, v]: how well each splat is seen at the moments `times` [v]; it moves with these parts of the way.
        """
        parts = [self.at(float(time)) for time in times]
        known = weights.sum(1) > 0
        shares = np.where(known[:, None], weights, 1.0)
        shares = shares / shares.sum(1, keepdims=True)
        points = scene.means.astype(np.float64)
        means, log_scale = np.zeros_like(points), np.zeros(len(scene))
        for part, share in zip(parts, shares.T, strict=True):
            means += share[:, None] * part.points(points)
            log_scale += share * np.log(part.scale)
        nearest = shares.argmax(1)
        turns = np.stack([part.rotation for part in parts])
        harmonics = None if scene.harmonics is None else scene.harmonics.copy()
        if harmonics is not None:
            for number, turn in enumerate(turns):
                harmonics[nearest == number] = rotated_harmonics(harmonics[nearest == number], turn)
        moved = Scene(
            np.ascontiguousarray(means, np.float32),
            np.ascontiguousarray(turned_quaternions(quaternion(turns)[nearest], scene.quats), np.float32),
            np.ascontiguousarray(scene.log_scales + log_scale[:, None], np.float32),
            scene.opacity_logits.copy(),
            scene.colours,
            scene.white,
            harmonics,
        )
        return brightened(moved, brightness)
