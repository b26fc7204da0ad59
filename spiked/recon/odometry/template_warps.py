"""How the appearance of tracks changes with the pose of the camera."""

import numpy as np
from numpy.typing import NDArray

from spiked.pose import Array
from spiked.recon.frontend.feature_tracks import NO_WARPS, Tracks
from spiked.recon.odometry.sparse_map import Pose, SparseMap
from spiked.sensor import LEAST_DEPTH

WARP_RANGE = (0.6, 1.7)
"""Singular values of the warps that are used: beyond, a track keeps the template as it is."""


def template_warps(sparse_map: SparseMap, tracks: Tracks, pose: Pose) -> NDArray[np.float32]:
    """How offsets from each live track in its first view appear in a view at `pose`, [live, 2, 2].

    The surface around a track is taken to be parallel to the image plane of its first view. Tracks without a point are
    taken to be far away.
    """
    if not len(tracks.ids):
        return NO_WARPS
    born, row = np.unique(tracks.born, return_inverse=True)
    first = [sparse_map.views[number].pose or pose for number in born.tolist()]
    rotations, centres = np.stack([p.rotation for p in first])[row], np.stack([p.centre for p in first])[row]
    points = sparse_map.points[tracks.ids]
    known = np.isfinite(points[:, 0])
    depth = np.where(known, ((points - centres) * rotations[:, :, 2]).sum(1), 1.0)
    turn = pose.rotation.T @ rotations
    shift = np.where(known[:, None], (centres - pose.centre) @ pose.rotation, 0.0)
    k = sparse_map.intrinsics
    focal = np.array([k.fx, k.fy])
    rays = k.unproject(tracks.birthplace)
    at = depth[:, None] * np.einsum("nij,nj->ni", turn, rays) + shift
    warps = _jacobians(turn, depth, at)
    if k.distortion is None:
        warps = warps * focal[:, None] / focal
    else:
        seen, before = (k.by_slope(ray[:, :2] / np.maximum(ray[:, 2:], LEAST_DEPTH)) for ray in (at, rays))
        warps = seen @ warps @ np.linalg.inv(before)
    sizes = np.linalg.svd(warps, compute_uv=False)
    warps[~((sizes > WARP_RANGE[0]) & (sizes < WARP_RANGE[1])).all(1)] = np.eye(2)
    return np.ascontiguousarray(warps, np.float32)


def _jacobians(turn: Array, depth: Array, at: Array) -> Array:
    """Derivatives [n, 2, 2] of the projection of a point at `at` [n, 3], in the view's frame, with respect to that in
    the first view, on a plane at `depth` [n] there; identity where the point is behind either view."""
    ahead = (depth > 0) & (at[:, 2] > 0)
    z = np.where(ahead, at[:, 2], 1.0)
    projected = at[:, :2] / z[:, None]
    out = (depth / z)[:, None, None] * (turn[:, :2, :2] - projected[:, :, None] * turn[:, 2:, :2])
    out[~ahead] = np.eye(2)
    return np.asarray(out)
