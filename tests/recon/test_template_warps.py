"""Templates of tracks, deformed as the pose of the camera says."""

import cv2
import numpy as np
import spiked.native._tracking as _tracking

from spiked.pose import exp_so3
from spiked.recon.frontend.feature_tracks import NO_WARPS, Tracks, picture, pyramid
from spiked.recon.odometry.sparse_map import Pose, SparseMap, TrackedView
from spiked.recon.odometry.template_warps import template_warps
from spiked.recon.odometry.tracking_state import State
from spiked.sensor import Intrinsics

H, W = 200, 240
K = Intrinsics(210.0, 200.0, 118.0, 103.0)


def smooth_image(seed: int) -> np.ndarray:
    rough = np.random.default_rng(seed).random((H, W)).astype(np.float32)
    return picture(np.clip(0.5 + 6 * (cv2.GaussianBlur(rough, (0, 0), 2.0) - 0.5), 0, 1), 1.0)


def tracked(places: np.ndarray, depth: float) -> tuple[SparseMap, Tracks]:
    """A map of one view at the origin, whose tracks have points at this depth."""
    ids = np.arange(len(places))
    sparse_map = SparseMap(K)
    pose = Pose(np.eye(3), np.zeros(3))
    sparse_map.views.append(TrackedView(0, 32.0, 64, ids, places, 0.0, State.TRACK, pose))
    sparse_map.reserve(len(places))
    sparse_map.points[:] = K.unproject(places) * depth
    tracks = Tracks()
    tracks.resume(0, ids, places)
    return sparse_map, tracks


def test_a_warp_is_the_derivative_of_the_projection_of_a_parallel_plane() -> None:
    places = np.random.default_rng(1).uniform(20, 180, (30, 2))
    sparse_map, tracks = tracked(places, 2.5)
    pose = Pose(exp_so3(np.array([0.05, -0.3, 0.1])), np.array([0.2, -0.1, 0.3]))

    def moved(at: np.ndarray) -> np.ndarray:
        return np.asarray(K.project((K.unproject(at) * 2.5 - pose.centre) @ pose.rotation))

    steps = [(moved(places + step) - moved(places - step)) / 0.02 for step in np.array([[0.01, 0], [0, 0.01]])]
    assert np.allclose(template_warps(sparse_map, tracks, pose), np.stack(steps, 2), atol=1e-4)


def test_tracks_without_a_point_are_taken_to_be_far_away() -> None:
    sparse_map, tracks = tracked(np.array([[60.0, 80.0], [170.0, 150.0]]), 1.0)
    turn = exp_so3(np.array([0.0, 0.3, 0.0]))
    sparse_map.points[:] *= 1e6
    far = template_warps(sparse_map, tracks, Pose(turn, np.ones(3)))
    sparse_map.points[:] = np.nan
    assert np.allclose(template_warps(sparse_map, tracks, Pose(turn, np.ones(3))), far, atol=1e-4)


def test_a_view_from_behind_or_far_aside_leaves_templates_as_they_are() -> None:
    sparse_map, tracks = tracked(np.array([[60.0, 80.0], [170.0, 150.0]]), 1.0)
    for angle in (np.pi, 1.3):
        warps = template_warps(sparse_map, tracks, Pose(exp_so3(np.array([0.0, angle, 0.0])), np.zeros(3)))
        assert np.array_equal(warps, np.tile(np.eye(2), (2, 1, 1)))
    assert len(template_warps(sparse_map, Tracks(), Pose(np.eye(3), np.zeros(3)))) == 0


def test_a_warped_template_is_found_where_it_is() -> None:
    """The image is stretched by a third and sheared, as at its edge after a turn."""
    image, warp = smooth_image(3), np.array([[1.3, 0.1], [0.05, 1.02]])
    places = np.random.default_rng(4).uniform(60, 130, (40, 2))
    shift = np.array([5.0, 3.0]) - (warp - np.eye(2)) @ places.mean(0)
    pixel_centres = np.column_stack([warp, shift + warp @ [0.5, 0.5] - 0.5])
    turned = cv2.warpAffine(image, pixel_centres, (W, H), flags=cv2.INTER_CUBIC)
    there = places @ warp.T + shift

    def errors(warps: np.ndarray) -> tuple[float, float]:
        at, good = there + np.array([0.4, -0.3]), np.zeros(len(places), bool)
        levels = [pyramid(one, 0)[0] for one in (image, turned)]
        birth = np.zeros(len(places), np.int64)
        _tracking.refine_tracks(levels[:1], birth, levels[1], places, warps, at, 0.6, 1.5, good)
        return float(np.median(np.linalg.norm(at - there, axis=1))), float(good.mean())

    error, found = errors(np.tile(warp, (len(places), 1, 1)).astype(np.float32))
    unwarped, found_unwarped = errors(NO_WARPS)
    assert error < 0.05 and found > 0.9
    assert error < unwarped / 3 and found >= found_unwarped
