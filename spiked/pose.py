"""Rotations and rigid poses: exponential, logarithm, Jacobians and quaternions of SO(3), for stacks of any shape.

A pose is a camera-to-world rotation and a centre (SO(3) x R^3). Perturbations are on the left: R <- Exp(phi) R.
Formulas: J. Sola, J. Deray, D. Atchuthan, "A micro Lie theory for state estimation in robotics", 2018.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

_SMALL = 1e-4
"""Below this angle (rad) the series are used; their next term is under 1e-16."""


def hat(phi: ArrayLike) -> Array:
    """Skew matrices of vectors: [..., 3] -> [..., 3, 3]."""
    v = np.asarray(phi, float)
    zero = np.zeros_like(v[..., 0])
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    return np.stack([np.stack([zero, -z, y], -1), np.stack([z, zero, -x], -1), np.stack([-y, x, zero], -1)], -2)


def _coefficients(phi: Array) -> tuple[Array, Array, Array]:
    """sin(t)/t, (1-cos t)/t^2, (t-sin t)/t^3 of the angles t = |phi|, each [..., 1, 1]."""
    angle = np.linalg.norm(phi, axis=-1)[..., None, None]
    small = angle < _SMALL
    safe = np.where(small, 1.0, angle)
    square = angle * angle
    a = np.where(small, 1 - square / 6, np.sin(safe) / safe)
    b = np.where(small, 0.5 - square / 24, (1 - np.cos(safe)) / safe**2)
    c = np.where(small, 1 / 6 - square / 120, (safe - np.sin(safe)) / safe**3)
    return a, b, c


def exp_so3(phi: ArrayLike) -> Array:
    """Rotation matrices of rotation vectors in radians: [..., 3] -> [..., 3, 3]."""
    v = np.asarray(phi, float)
    a, b, _ = _coefficients(v)
    k = hat(v)
    return np.asarray(np.eye(3) + a * k + b * (k @ k))


def log_so3(rotation: ArrayLike) -> Array:
    """Rotation vectors in radians, angle at most pi: [..., 3, 3] -> [..., 3]."""
    q = quaternion(rotation)
    w, xyz = q[..., :1], q[..., 1:]
    sine = np.linalg.norm(xyz, axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, w)
    small = sine < _SMALL
    scale = np.where(
        small, 2 / np.where(small, w, 1.0) * (1 - sine**2 / (3 * w**2 + (w == 0))), angle / np.where(small, 1.0, sine)
    )
    return np.asarray(scale * xyz)


def right_jacobian(phi: ArrayLike) -> Array:
    """Jr with Exp(phi + d) ~ Exp(phi) Exp(Jr d): [..., 3] -> [..., 3, 3]."""
    v = np.asarray(phi, float)
    _, b, c = _coefficients(v)
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
    """Unit quaternions wxyz with w >= 0: [..., 3, 3] -> [..., 4].

    The largest of the four components is found first, so that no division is by a small number (Shepperd 1978).
    """
    m = np.asarray(rotation, float)
    trace = m[..., 0, 0] + m[..., 1, 1] + m[..., 2, 2]
    squares = np.stack([trace, m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]], -1)
    p = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    s = m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1]
    d = [1 + 2 * m[..., i, i] - trace for i in range(3)]
    candidates = np.stack(
        [
            np.stack([1 + trace, p[0], p[1], p[2]], -1),
            np.stack([p[0], d[0], s[0], s[1]], -1),
            np.stack([p[1], s[0], d[1], s[2]], -1),
            np.stack([p[2], s[1], s[2], d[2]], -1),
        ],
        -2,
    )
    q = np.take_along_axis(candidates, np.argmax(squares, -1)[..., None, None], -2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.asarray(np.where(q[..., :1] < 0, -q, q))


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
