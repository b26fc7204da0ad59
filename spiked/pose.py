"""Rotations: exponential, logarithm and quaternions of SO(3), for stacks of any shape.

A pose is a camera-to-world rotation and a centre (SO(3) x R^3). Perturbations are on the left: R <- Exp(phi) R.
Formulas: J. Sola, J. Deray, D. Atchuthan, "A micro Lie theory for state estimation in robotics", 2018.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

import spiked.native._geometry as _geometry

__all__ = ["exp_so3", "hat", "log_so3", "mean_rotation", "quaternion", "rotation_of"]

Array = NDArray[np.float64]


def hat(phi: ArrayLike) -> Array:
    """Skew matrices of vectors: [..., 3] -> [..., 3, 3]."""
    v = np.asarray(phi, float)
    zero = np.zeros_like(v[..., 0])
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    return np.stack([np.stack([zero, -z, y], -1), np.stack([z, zero, -x], -1), np.stack([-y, x, zero], -1)], -2)


def exp_so3(phi: ArrayLike) -> Array:
    """Rotation matrices of rotation vectors in radians: [..., 3] -> [..., 3, 3]."""
    v = np.ascontiguousarray(phi, float)
    out = np.empty((*v.shape, 3))
    _geometry.exponentials(v.reshape(-1, 3), out.reshape(-1, 9))
    return out


def log_so3(rotation: ArrayLike) -> Array:
    """Rotation vectors in radians, angle at most pi: [..., 3, 3] -> [..., 3]."""
    m = np.ascontiguousarray(rotation, float)
    out = np.empty(m.shape[:-1])
    _geometry.logarithms(m.reshape(-1, 9), out.reshape(-1, 3))
    return out


def quaternion(rotation: ArrayLike) -> Array:
    """Unit quaternions wxyz with w >= 0: [..., 3, 3] -> [..., 4]."""
    m = np.ascontiguousarray(rotation, float)
    out = np.empty((*m.shape[:-2], 4))
    _geometry.quaternions(m.reshape(-1, 9), out.reshape(-1, 4))
    return out


def rotation_of(wxyz: ArrayLike) -> Array:
    """Rotation matrices of quaternions wxyz of any length but zero: [..., 4] -> [..., 3, 3]."""
    q = np.asarray(wxyz, float)
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    w, x, y, z = np.moveaxis(q, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def mean_rotation(rotations: Array) -> Array:
    """The chordal mean of rotations: [n, 3, 3] -> [3, 3]."""
    u, _, vt = np.linalg.svd(rotations.sum(0))
    return np.asarray(u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt)
