"""Rotations and rigid poses: exponential, logarithm, Jacobians and quaternions of SO(3), for stacks of any shape.

A pose is a camera-to-world rotation and a centre (SO(3) x R^3). Perturbations are on the left: R <- Exp(phi) R.
Formulas: J. Sola, J. Deray, D. Atchuthan, "A micro Lie theory for state estimation in robotics", 2018.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

import spiked.native._odometry as _odometry

Array = NDArray[np.float64]

_SMALL = 1e-4
"""Below this angle (rad) the series are used; their next term is under 1e-16."""


def hat(phi: ArrayLike) -> Array:
    """Skew matrices of vectors: [..., 3] -> [..., 3, 3]."""
    v = np.asarray(phi, float)
    zero = np.zeros_like(v[..., 0])
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    return np.stack([np.stack([zero, -z, y], -1), np.stack([z, zero, -x], -1), np.stack([-y, x, zero], -1)], -2)


def _coefficients(phi: Array) -> tuple[Array, Array]:
    """(1-cos t)/t^2, (t-sin t)/t^3 of the angles t = |phi|, each [..., 1, 1]."""
    angle = np.linalg.norm(phi, axis=-1)[..., None, None]
    small = angle < _SMALL
    safe = np.where(small, 1.0, angle)
    square = angle * angle
    b = np.where(small, 0.5 - square / 24, (1 - np.cos(safe)) / safe**2)
    c = np.where(small, 1 / 6 - square / 120, (safe - np.sin(safe)) / safe**3)
    return b, c


def exp_so3(phi: ArrayLike) -> Array:
    """Rotation matrices of rotation vectors in radians: [..., 3] -> [..., 3, 3]."""
    v = np.ascontiguousarray(phi, float)
    out = np.empty((*v.shape, 3))
    _odometry.exponentials(v.reshape(-1, 3), out.reshape(-1, 9))
    return out


def log_so3(rotation: ArrayLike) -> Array:
    """Rotation vectors in radians, angle at most pi: [..., 3, 3] -> [..., 3]."""
    m = np.ascontiguousarray(rotation, float)
    out = np.empty(m.shape[:-1])
    _odometry.logarithms(m.reshape(-1, 9), out.reshape(-1, 3))
    return out


def right_jacobian(phi: ArrayLike) -> Array:
    """Jr with Exp(phi + d) ~ Exp(phi) Exp(Jr d): [..., 3] -> [..., 3, 3]."""
    v = np.asarray(phi, float)
    b, c = _coefficients(v)
    k = hat(v)
    return np.asarray(np.eye(3) - b * k + c * (k @ k))


def inverse_right_jacobian(phi: ArrayLike) -> Array:
    """The inverse of `right_jacobian`, for angles below pi: [..., 3] -> [..., 3, 3]."""
    v = np.asarray(phi, float)
    angle = np.linalg.norm(v, axis=-1)[..., None, None]
    small = angle < _SMALL
    safe = np.where(small, 1.0, angle)
    half = 0.5 * safe
    e = np.where(small, 1 / 12 + angle**2 / 720, (1 - half / np.tan(half)) / safe**2)
    k = hat(v)
    return np.asarray(np.eye(3) + 0.5 * k + e * (k @ k))


def quaternion(rotation: ArrayLike) -> Array:
    """Unit quaternions wxyz with w >= 0: [..., 3, 3] -> [..., 4]."""
    m = np.ascontiguousarray(rotation, float)
    out = np.empty((*m.shape[:-2], 4))
    _odometry.quaternions(m.reshape(-1, 9), out.reshape(-1, 4))
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
