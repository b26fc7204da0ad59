"""Predicted error of the shape of a whole path, from the covariance of the global bundle adjustment.

Residuals do not show it: each view may fit its points to 0.1 px while the path bends or its scale drifts, as new points
are triangulated from poses and new poses estimated from points.
"""

import numpy as np

from spiked.pose import Array, hat
from spiked.recon.odometry.bundle_adjustment import Bundle
from spiked.spline import Spline

GAUGE_EIGENVALUE_RATIO = 1e-10
"""Eigenvalues below this share of the largest belong to the gauge: position, orientation and scale of the world."""


def path_error(bundle: Bundle, spline: Spline, times: Array, scale_px: float) -> float:
    """Predicted RMS error of the camera's centres at `times` after alignment by a similarity, relative to the RMS
    radius of the path, for tracks with independent errors; infinite for a path without extent."""
    _, centres = spline.poses(times)
    middle = centres - centres.mean(0)
    radius = float(np.sqrt((middle**2).sum(1).mean()))
    if radius == 0:
        return float("inf")
    value, vector = np.linalg.eigh(bundle.spline_information(spline, times, scale_px))
    kept = value > GAUGE_EIGENVALUE_RATIO * value[-1]
    root = vector[:, kept] / np.sqrt(value[kept])  # covariance = root root^T
    knots = len(spline.centres)
    by_view = spline.basis_matrix(times) @ root.reshape(knots, 6, -1)[:, 3:].transpose(1, 0, 2)  # [3, views, modes]
    moved = by_view.transpose(1, 0, 2).reshape(3 * len(times), -1)
    turn = -hat(middle).reshape(-1, 3)
    free = np.column_stack([np.tile(np.eye(3), (len(times), 1)), turn, middle.reshape(-1)])
    basis, _ = np.linalg.qr(free)
    moved = moved - basis @ (basis.T @ moved)
    return float(bundle.noise_px() * np.sqrt((moved**2).sum() / len(times)) / radius)
