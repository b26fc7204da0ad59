"""A distortion that nobody stated, found in the keyframes of a long path."""

import numpy as np
import pytest

from spiked.distortion import Distortion, LensModel
from spiked.pose import exp_so3
from spiked.recon.odometry.keyframe_adjuster import LENS_KEYFRAMES, KeyframeAdjuster
from spiked.recon.odometry.keyframe_pictures import KeyframePictures
from spiked.recon.odometry.loop_closure import LoopSearch
from spiked.recon.odometry.sparse_map import Pose, SparseMap, TrackedView
from spiked.recon.odometry.tracking_state import State
from spiked.sensor import Intrinsics

PINHOLE = Intrinsics.from_fov(400, 250, 60)
LENS = Distortion(LensModel.OPENCV, (-0.3, 0.1))
VIEWS, POINTS, NOISE_PX, STEP_PX = LENS_KEYFRAMES + 20, 500, 0.05, 5.0


def keyframes(seen_through: Intrinsics, seed: int = 0) -> KeyframeAdjuster:
    """A path along a wall in relief, turning, with true poses and points and the tracks of a lens, all keyframes."""
    rng = np.random.default_rng(seed)
    points = np.stack([rng.uniform(-3, 8, POINTS), rng.uniform(-2, 2, POINTS), 3 + rng.uniform(0, 2.5, POINTS)], axis=1)
    sparse_map = SparseMap(PINHOLE)
    sparse_map.reserve(POINTS)
    sparse_map.points[:] = points
    for number in range(VIEWS):
        share = number / VIEWS
        rotation = exp_so3(np.array([0.1 * np.sin(9 * share), 0.4 * np.sin(7 * share), 0.3 * np.sin(5 * share)]))
        pose = Pose(rotation, np.array([5 * share, 0.3 * np.sin(11 * share), 0.4 * np.sin(6 * share)]))
        local = (points - pose.centre) @ pose.rotation
        pixels = seen_through.project(local) + rng.normal(0, NOISE_PX, (POINTS, 2))
        ids = np.flatnonzero((local[:, 2] > 0.5) & ((pixels > 0) & (pixels < (400, 250))).all(1))
        view = TrackedView(number, 64.0 * number, 64, ids, pixels[ids], STEP_PX, State.TRACK, pose)
        sparse_map.views.append(view)
    return KeyframeAdjuster(sparse_map, {}, LoopSearch.of(sparse_map, KeyframePictures()))


def test_a_lens_is_found_while_keyframes_are_adjusted() -> None:
    adjuster = keyframes(Intrinsics(PINHOLE.fx, PINHOLE.fy, PINHOLE.cx, PINHOLE.cy, LENS))
    assert adjuster.due
    adjuster.adjust()
    assert adjuster.map.lens is not None
    found = adjuster.map.intrinsics.distortion
    assert found is not None and found.coefficients[:2] == pytest.approx((-0.3, 0.1), abs=0.03)
    adjuster.settle()
    adjuster.finish()
    found = adjuster.map.intrinsics.distortion
    assert found is not None and found.coefficients[:2] == pytest.approx((-0.3, 0.1), abs=0.02)


def test_a_live_camera_does_not_wait_for_the_search() -> None:
    adjuster = keyframes(Intrinsics(PINHOLE.fx, PINHOLE.fy, PINHOLE.cx, PINHOLE.cy, LENS))
    adjuster.live = True
    assert adjuster.due
    adjuster.adjust()
    search = adjuster._lens_search
    assert search is not None
    search.result()
    assert adjuster.map.lens is None
    adjuster.adjust()
    assert adjuster.map.lens is not None and adjuster._lens_search is None


def test_no_lens_is_found_in_keyframes_of_a_pinhole_camera() -> None:
    adjuster = keyframes(PINHOLE)
    adjuster.adjust()
    adjuster.finish()
    assert adjuster.map.lens is None and adjuster.map.intrinsics == PINHOLE


def test_a_stated_lens_is_left_alone() -> None:
    adjuster = keyframes(PINHOLE)
    adjuster.map.lens_known = True
    adjuster.adjust()
    assert adjuster.map.intrinsics == PINHOLE
