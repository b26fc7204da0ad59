"""A reconstruction that is finished: its scene, the way through it, and the camera that made it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from spiked.evaluate import Similarity
from spiked.harmonics import rotated_harmonics
from spiked.pose import Array, quaternion
from spiked.render import Camera
from spiked.scene import Scene
from spiked.trajectory import Trajectory

APART_S = 1.0
"""Time between two paths that are put one after the other."""


@dataclass(frozen=True)
class KnownMap:
    """A scene and the poses that it was seen from, in one frame of reference."""

    scene: Scene
    trajectory: Trajectory
    """Camera to world. Several paths one after the other, with times that increase, for a map of several recordings."""
    camera: Camera

    @classmethod
    def of(cls, scene: Scene, paths: Sequence[Trajectory], camera: Camera) -> "KnownMap":
        """A map of several recordings: each path begins `APART_S` after the end of the one before."""
        times: list[Array] = []
        for path in paths:
            begin = times[-1][-1] + APART_S if times and len(times[-1]) else 0.0
            times.append(path.times_s - path.times_s[:1] + begin)
        rotations, centres = ([getattr(path, name) for path in paths] for name in ("rotations", "centres"))
        poses = Trajectory(np.concatenate(times), np.concatenate(rotations), np.concatenate(centres))
        return cls(scene, poses, camera)

    def moved(self, similarity: Similarity, brightness: float = 1.0) -> "KnownMap":
        """The map in another frame of reference, its radiance multiplied by `brightness`."""
        scene = moved_scene(self.scene, similarity, brightness)
        return replace(self, scene=scene, trajectory=moved_path(self.trajectory, similarity))


def coloured(scene: Scene) -> Scene:
    """A scene with three colours: grey surfaces have them alike."""
    colours = np.ascontiguousarray(np.broadcast_to(scene.colours, (len(scene), 3)))
    harmonics = scene.harmonics
    if harmonics is not None:
        harmonics = np.ascontiguousarray(np.broadcast_to(harmonics, (*harmonics.shape[:2], 3)))
    return replace(scene, colours=colours, harmonics=harmonics)


def brightened(scene: Scene, brightness: float) -> Scene:
    """A scene with its radiance multiplied by `brightness`."""
    white = None if scene.white is None else scene.white * brightness
    harmonics = None if scene.harmonics is None else scene.harmonics * np.float32(brightness)
    return replace(scene, colours=scene.colours * np.float32(brightness), white=white, harmonics=harmonics)


def moved_path(path: Trajectory, similarity: Similarity) -> Trajectory:
    """A trajectory in another frame of reference."""
    return Trajectory(path.times_s, *similarity.poses(path.rotations, path.centres))


def moved_scene(scene: Scene, similarity: Similarity, brightness: float = 1.0) -> Scene:
    """A copy of a scene in another frame of reference, its radiance multiplied by `brightness`."""
    turn = quaternion(similarity.rotation)
    moved = Scene(
        np.ascontiguousarray(similarity.points(scene.means.astype(np.float64)), np.float32),
        np.ascontiguousarray(turned_quaternions(turn, scene.quats), np.float32),
        scene.log_scales + np.float32(np.log(similarity.scale)),
        scene.opacity_logits.copy(),
        scene.colours,
        scene.white,
        None if scene.harmonics is None else rotated_harmonics(scene.harmonics, similarity.rotation),
    )
    return brightened(moved, brightness)


def turned_quaternions(by: Array, quats: NDArray[np.float32]) -> Array:
    """Products of quaternions [n, 4] or [4] and quaternions [n, 4], wxyz; a zero quaternion counts as no rotation."""
    q = np.where(np.abs(quats).sum(1, keepdims=True) > 0, quats, [1, 0, 0, 0]).astype(np.float64)
    w, v = by[..., :1], by[..., 1:]
    scalar = w * q[:, :1] - (v * q[:, 1:]).sum(1, keepdims=True)
    return np.concatenate([scalar, w * q[:, 1:] + q[:, :1] * v + np.cross(v, q[:, 1:])], 1)


def inverse(similarity: Similarity) -> Similarity:
    """From the target of a similarity back to its source."""
    back = similarity.rotation.T
    return Similarity(1 / similarity.scale, back, -back @ similarity.translation / similarity.scale)
