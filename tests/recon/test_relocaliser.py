"""A lost view is found again by the points of a keyframe, and only there."""

import cv2
import numpy as np

from spiked.recon import State
from spiked.recon.odometry.relocaliser import KEYFRAME_EVERY, Relocaliser
from spiked.recon.odometry.sparse_map import Pose, SparseMap, TrackedView
from spiked.sensor import Intrinsics

K = Intrinsics.from_fov(320, 240, 60)
STILL = Pose(np.eye(3), np.zeros(3))
DEPTH = 1.5


def texture(seed: int) -> np.ndarray:
    """A plane facing the camera, seen from the origin."""
    noise = np.random.default_rng(seed).integers(0, 255, (60, 80)).astype(np.uint8)
    return cv2.resize(noise, (320, 240), interpolation=cv2.INTER_CUBIC)


def known_map(picture: np.ndarray) -> tuple[SparseMap, Relocaliser]:
    """One keyframe at the origin with 200 points of the plane."""
    at = np.random.default_rng(5).uniform([30, 30], [290, 210], (200, 2))
    points = K.unproject(at) * DEPTH
    view = TrackedView(0, 8.0, 16, np.arange(200), at, 0.0, State.TRACK, STILL)
    sparse_map = SparseMap(K, views=[view], points=points)
    relocaliser = Relocaliser(sparse_map)
    relocaliser.remember(view, picture)
    return sparse_map, relocaliser


def lost(number: int = 1) -> TrackedView:
    return TrackedView(number, 200.0, 16, np.zeros(0, np.int64), np.zeros((0, 2)), 0.0, State.LOST)


def test_a_view_shifted_by_a_tenth_of_the_image_is_found() -> None:
    picture = texture(1)
    sparse_map, relocaliser = known_map(picture)
    view = lost()
    fit = relocaliser.find(view, np.roll(picture, (8, -32), (0, 1)))
    assert fit is not None
    # The plane moved by (-32, 8) px, so the camera by (32, -8) px at its depth.
    assert np.linalg.norm(fit.pose.centre - np.array([32, -8, 0]) * DEPTH / K.fx) < 5e-3
    assert len(view.ids) > 100
    assert np.abs(view.pixels - sparse_map.views[0].pixels_of(view.ids) - [-32, 8]).max() < 0.5


def test_older_keyframes_are_tried_in_turn() -> None:
    sparse_map, relocaliser = known_map(texture(1))
    first = sparse_map.views[0]
    for number in range(1, 15):
        sparse_map.views.append(TrackedView(number, 8.0, 16, first.ids, first.pixels, 0.0, State.TRACK, STILL))
        relocaliser.keyframes[number] = texture(number + 1)
    relocaliser.older_tried = 4
    found = [relocaliser.find(lost(15), texture(number)) is not None for number in (5, 5, 5, 14, 14)]
    assert found == [False, True, False, True, True]  # the fifth, in its turn; one of the newest, always


def test_a_foreign_view_is_not_found_and_not_changed() -> None:
    _, relocaliser = known_map(texture(1))
    view = lost()
    assert relocaliser.find(view, texture(2)) is None
    assert len(view.ids) == 0 and view.pose is None


def test_every_eighth_view_with_a_pose_is_a_keyframe() -> None:
    relocaliser = Relocaliser(SparseMap(K))
    for number in range(2 * KEYFRAME_EVERY + 1):
        view = lost(number)
        view.pose = None if number == KEYFRAME_EVERY else STILL
        relocaliser.remember(view, texture(1))
    assert sorted(relocaliser.keyframes) == [0, 2 * KEYFRAME_EVERY]


def test_views_far_apart_are_keyframes_whatever_their_numbers() -> None:
    relocaliser = Relocaliser(SparseMap(K), most_motion_px=24.0)
    for number in range(7):
        view = lost(number)
        view.pose, view.motion_px = STILL, 10.0
        relocaliser.remember(view, texture(1))
    assert sorted(relocaliser.keyframes) == [0, 3, 6]
