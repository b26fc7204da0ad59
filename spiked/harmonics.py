"""Colour that depends on where it is seen from: real spherical harmonics of degrees 1 to 3, as 3DGS files have them.

Basis, order and signs are those of the 3D Gaussian splatting papers' code, of the direction from the camera to the
splat. The coefficients of degree d are 2 d + 1 numbers a channel; that of degree 0 is part of the colour.
"""

import numpy as np
from numpy.typing import NDArray

__all__ = ["COEFFICIENTS", "degree_of", "harmonic_basis", "rotated_harmonics"]

COEFFICIENTS = (0, 3, 8, 15)
"""Of a channel, beyond the constant one, by degree."""
SAMPLES = 256
"""Directions by which a rotation of coefficients is found; 15 are necessary."""
Doubles = NDArray[np.float64]
Floats = NDArray[np.float32]


def degree_of(harmonics: Floats | None) -> int:
    """The degree of coefficients [N, K, C]; 0 for None."""
    return 0 if harmonics is None else COEFFICIENTS.index(harmonics.shape[1])


def harmonic_basis(directions: Doubles) -> Doubles:
    """The 15 functions of degrees 1 to 3 at unit vectors [n, 3], [n, 15]."""
    x, y, z = directions.T
    xx, yy, zz = x * x, y * y, z * z
    first = 0.4886025119029199 * np.stack([-y, z, -x], 1)
    second = np.stack(
        [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2 * zz - xx - yy),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (xx - yy),
        ],
        1,
    )
    third = np.stack(
        [
            -0.5900435899266435 * y * (3 * xx - yy),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * zz - xx - yy),
            0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
            -0.4570457994644658 * x * (4 * zz - xx - yy),
            1.445305721320277 * z * (xx - yy),
            -0.5900435899266435 * x * (xx - 3 * yy),
        ],
        1,
    )
    return np.concatenate([first, second, third], 1)


def rotated_harmonics(harmonics: Floats, rotation: Doubles) -> Floats:
    """Coefficients [N, K, C] of the same colours after the scene was turned by a rotation [3, 3]."""
    count = harmonics.shape[1]
    directions = np.random.default_rng(0).standard_normal((SAMPLES, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    after, before = (harmonic_basis(some)[:, :count] for some in (directions, directions @ rotation))
    matrix = np.linalg.lstsq(after, before, rcond=None)[0]  # exact: a rotation mixes coefficients of a degree alone
    return np.asarray(np.einsum("jk,nkc->njc", matrix, harmonics), np.float32)
