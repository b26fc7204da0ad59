"""Equations of the whole path and the map's places, from all pixels of its views."""

import numpy as np
import pytest
import spiked.native._dense as _dense

from spiked.pose import Array, exp_so3, log_so3
from spiked.recon.mapping.pose_alignment import (
    DRIFT_PX,
    LONG_MODEL,
    TrajectoryPrior,
    ViewNormals,
    marginalise_landmarks,
)
from spiked.render import Camera
from spiked.sensor import Intrinsics
from spiked.spline import Spline, Waypoints

CAMERA = Camera(Intrinsics(150.0, 152.0, 79.0, 51.0), 160, 100)
NORMAL, OFFSET = np.array([0.15, -0.1, 1.0]), 2.0
"""A slanted wall: NORMAL . point = OFFSET."""
WIDTH_RAD = 16 / 150


def wall(rotation: np.ndarray, centre: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A smoothly painted wall as seen from a pose, its depth [h, w], and the points of it [h, w, 3]."""
    k = CAMERA.intrinsics
    v, u = np.mgrid[0 : CAMERA.height, 0 : CAMERA.width] + 0.5
    local = np.stack([(u - k.cx) / k.fx, (v - k.cy) / k.fy, np.ones_like(u)], -1)
    rays = local @ rotation.T
    depth = (OFFSET - NORMAL @ centre) / (rays @ NORMAL)
    points = centre + rays * depth[..., None]
    x, y, z = np.moveaxis(points, -1, 0)
    return np.sin(7 * x + 2 * y) + np.sin(5 * y - 3 * z) + 0.5 * np.cos(9 * (x + y)), depth, points


def summed(
    error: np.ndarray,
    image: np.ndarray,
    depth: np.ndarray,
    weight: np.ndarray,
    rotation: np.ndarray,
    centre: np.ndarray,
) -> ViewNormals:
    k = CAMERA.intrinsics
    dv, du = np.gradient(image)
    pose, keys, places = np.empty((6, 7)), np.empty(weight.size, np.int64), np.empty((weight.size, 3, 10))
    images = [np.ascontiguousarray(one, np.float32) for one in (error, du, dv, depth, weight)]
    count = _dense.photometric_normals(*images, k.fx, k.fy, k.cx, k.cy, rotation, centre, WIDTH_RAD, pose, keys, places)
    return ViewNormals(pose, keys[:count], places[:count], 1.0)


def test_the_step_of_a_pose_explains_a_camera_that_moved() -> None:
    rotation, centre = exp_so3(np.array([0.05, -0.1, 0.2])), np.array([0.1, 0.05, -0.1])
    image, depth, _ = wall(rotation, centre)
    moved = np.array([4e-4, -3e-4, 5e-4, 6e-4, -5e-4, 7e-4])
    seen, _, _ = wall(exp_so3(moved[:3]) @ rotation, centre + moved[3:])
    sums = summed(image - seen, image, depth, np.ones(depth.shape), rotation, centre)
    np.testing.assert_allclose(-np.linalg.solve(sums.pose[:, :6], sums.pose[:, 6]), moved, atol=3e-5)


def test_pixels_say_the_same_of_a_camera_and_of_all_that_it_sees_moving_the_other_way() -> None:
    rng = np.random.default_rng(0)
    rotation, centre = exp_so3(np.array([0.05, -0.1, 0.2])), np.array([0.1, 0.05, -0.1])
    image, depth, _ = wall(rotation, centre)
    weight = rng.uniform(0, 1, depth.shape) * (rng.uniform(0, 1, depth.shape) > 0.4)
    sums = summed(rng.normal(0, 1, depth.shape), image, depth, weight, rotation, centre)
    np.testing.assert_allclose(sums.places[:, :, 9].sum(0), -sums.pose[3:, 6], rtol=1e-6)
    np.testing.assert_allclose(sums.places[:, :, :3].sum(0), sums.pose[3:, 3:6], rtol=1e-6)
    np.testing.assert_allclose(sums.places[:, :, 3:9].sum(0), -sums.pose[3:, :6], rtol=1e-6)
    # Cubes of 11 to 23 px on a wall of 160 x 100.
    assert 20 < len(sums.keys) < 400
    assert len(np.unique(sums.keys)) == len(sums.keys)


def test_near_and_far_places_are_about_as_large_in_the_image() -> None:
    counts = []
    for scale in (0.01, 1.0, 100.0):
        image, depth, _ = wall(np.eye(3), np.zeros(3))
        counts.append(len(summed(image, image, depth * scale, np.ones(depth.shape), np.eye(3), np.zeros(3)).keys))
    assert max(counts) < 2 * min(counts)


def test_images_that_differ_and_more_places_than_room_are_refused() -> None:
    image, k = np.ones((8, 8), np.float32), CAMERA.intrinsics
    pose, keys, places = np.empty((6, 7)), np.empty(64, np.int64), np.empty((64, 3, 10))
    rest = (k.fx, k.fy, k.cx, k.cy, np.eye(3), np.zeros(3))
    with pytest.raises(ValueError, match="alike"):
        _dense.photometric_normals(image, image, image, image, image[:4], *rest, WIDTH_RAD, pose, keys, places)
    with pytest.raises(ValueError, match="expected rotation"):
        _dense.photometric_normals(image, image, image, image, image, *rest, 0.0, pose, keys, places)
    with pytest.raises(ValueError, match="room"):
        _dense.photometric_normals(image, image, image, image, image, *rest, 1e-3, pose, keys[:2], places[:2])


def still(knots: int) -> Spline:
    return Spline(0.0, 8.0, np.tile(np.eye(3), (knots, 1, 1)), np.zeros((knots, 3)))


def test_the_path_is_found_although_every_place_of_the_map_has_moved() -> None:
    rng = np.random.default_rng(1)
    spline, places, pixels = still(9), 40, 60
    times = np.linspace(spline.begin, spline.end - 1e-6, 20)
    first, shares = spline.locate(times)
    moved, shifts = rng.normal(0, 1, (9, 6)), rng.normal(0, 3, (places, 3))
    whole = np.zeros((54 + 3 * places, 54 + 3 * places))
    sums, right = [], np.zeros(len(whole))
    for at, share in zip(first, shares, strict=True):
        seen = np.sort(rng.choice(places, 25, replace=False))
        number = rng.integers(0, len(seen), pixels * len(seen))
        by_place, by_pose = rng.normal(0, 1, (len(number), 3)), rng.normal(0, 1, (len(number), 6))
        pose = np.einsum("k,ki->i", share, moved[at : at + len(share)])
        error = -(by_pose @ pose + (by_place * shifts[seen[number]]).sum(1))
        rows = np.concatenate([by_place, by_pose, error[:, None]], 1)
        blocks = np.zeros((len(seen), 3, 10), np.float32)
        np.add.at(blocks, number, rows[:, :3, None] * rows[:, None])
        sums.append(ViewNormals(by_pose.T @ rows[:, 3:], 7 * seen + 3, blocks, 1.0))
        jacobian = np.zeros((len(number), len(whole)))
        for k, part in enumerate(share):
            jacobian[:, 6 * (at + k) : 6 * (at + k) + 6] = part * by_pose
        for i in range(3):
            jacobian[np.arange(len(number)), 54 + 3 * seen[number] + i] = by_place[:, i]
        whole += jacobian.T @ jacobian
        right += jacobian.T @ error

    by_view, slope = marginalise_landmarks(sums, LONG_MODEL)
    basis = np.kron(spline.basis_matrix(times), np.eye(6))
    square, gradient = basis.T @ by_view @ basis, slope @ basis
    held = np.linalg.norm(np.linalg.solve(whole[:54, :54], -right[:54]).reshape(9, 6) - moved)
    freed = np.linalg.norm(np.linalg.solve(square, -gradient).reshape(9, 6) - moved)
    assert held > 0.5  # a map taken to be right misleads
    assert freed < 0.03 * held
    # And the same as the exact Schur complement, up to how places are held.
    exact = whole[:54, :54] - whole[:54, 54:] @ np.linalg.solve(whole[54:, 54:], whole[54:, :54])
    np.testing.assert_allclose(square, exact, atol=1e-4 * np.abs(whole[:54, :54]).max())


def test_places_that_many_views_see_are_taken_out_as_from_the_whole_matrix() -> None:
    rng = np.random.default_rng(2)
    places, count = 50, 9
    whole = np.zeros((6 * count + 3 * places, 6 * count + 3 * places + 1))
    sums = []
    for view in range(count):
        rows = rng.normal(0, 1, (30, 8, 10))
        keys = rng.choice(places, 30, replace=False).astype(np.int64)
        blocks = np.einsum("pri,prj->pij", rows[:, :, :3], rows).astype(np.float32)
        sums.append(ViewNormals(np.einsum("pri,prj->ij", rows[:, :, 3:9], rows[:, :, 3:]), keys, blocks, 1.0))
        own = slice(6 * view, 6 * view + 6)
        whole[own, own], whole[own, -1] = sums[-1].pose[:, :6], sums[-1].pose[:, 6]
        for key, block in zip(keys, blocks, strict=True):
            place = slice(6 * count + 3 * key, 6 * count + 3 * key + 3)
            whole[place, place] += block[:, :3]
            whole[place, own], whole[own, place] = block[:, 3:9], block[:, 3:9].T
            whole[place, -1] += block[:, 9]
    cut = 6 * count
    solved = np.linalg.solve(whole[cut:, cut:-1], whole[cut:])
    exact = whole[:cut] - whole[:cut, cut:-1] @ solved
    square, gradient = marginalise_landmarks(sums, LONG_MODEL)
    np.testing.assert_allclose(square, exact[:, :cut], atol=1e-4 * np.abs(exact).max())
    np.testing.assert_allclose(gradient, exact[:, -1], atol=1e-4 * np.abs(exact).max())
    np.testing.assert_array_equal(square, square.T)


def test_blocks_that_do_not_fit_their_views_are_refused() -> None:
    keys, blocks = [np.zeros(4, np.int64)], [np.zeros((4, 3, 10), np.float32)]
    square, gradient = np.zeros((6, 6)), np.zeros(6)
    with pytest.raises(ValueError, match="same views"):
        _dense.marginalise(keys, [], 1e-5, 1e-6, square, gradient)
    with pytest.raises(ValueError, match="blocks"):
        _dense.marginalise(keys, [blocks[0][:3]], 1e-5, 1e-6, square, gradient)
    with pytest.raises(ValueError, match="gradient"):
        _dense.marginalise(keys, blocks, 1e-5, 1e-6, square, np.zeros(12))
    _dense.marginalise(keys, blocks, 1e-5, 1e-6, square, gradient)  # nothing was seen: nothing is known
    assert not square.any()
    assert not gradient.any()


def test_views_that_show_nothing_say_nothing() -> None:
    nothing = ViewNormals(np.zeros((6, 7)), np.zeros(0, np.int64), np.zeros((0, 3, 10), np.float32), 0.0)
    square, gradient = marginalise_landmarks([nothing, nothing], LONG_MODEL)
    assert not square.any()
    assert not gradient.any()


def test_what_was_known_pulls_a_path_back() -> None:
    rng = np.random.default_rng(3)
    spline = still(5)
    root = rng.normal(0, 1, (30, 30))
    known = TrajectoryPrior(spline.rotations, spline.centres, root @ root.T)
    step = rng.normal(0, 1e-3, (5, 6))
    other = spline.move(step[:, :3], step[:, 3:])
    np.testing.assert_allclose(log_so3(other.rotations), step[:, :3], atol=1e-9)
    back = np.linalg.solve(known.information, -known.gradient(other.rotations, other.centres)).reshape(5, 6)
    np.testing.assert_allclose(back, -step, atol=1e-8)
    assert not known.gradient(spline.rotations, spline.centres).any()


def test_drift_may_grow_along_a_path_but_not_jump() -> None:
    moved_px = np.array([4.0, 9.0, 0.0, 4.0])
    poses = np.tile(np.eye(3), (5, 1, 1)), np.zeros((5, 3))
    known = TrajectoryPrior.drifting(*poses, moved_px, rad=1e-3, depth=2.0)

    def energy(centres: Array) -> float:
        return 0.5 * float(known.gradient(poses[0], centres) @ np.concatenate([np.zeros((5, 3)), centres], 1).ravel())

    along = np.array([0.0, 1.0, 2.0, 2.0, 3.0])[:, None] * np.array([1e-5, 0, 0])
    assert energy(np.full((5, 3), 1e-3)) == pytest.approx(0.0, abs=1e-9)  # the frame of reference is free
    deviation = DRIFT_PX * 1e-3 * 2.0
    assert energy(along) == pytest.approx(0.5 * (1e-5 / deviation) ** 2 * (1 / 4 + 1 / 9 + 1 / 4))
    assert energy(along[[0, 2, 1, 3, 4]]) > 2 * energy(along)


def test_waypoints_are_bent_as_the_views_say() -> None:
    path = Waypoints(np.array([0.0, 10.0, 20.0, 30.0]), np.tile(np.eye(3), (4, 1, 1)), np.zeros((4, 3)))
    turns, ways = np.array([[0, 0, 0.2], [0, 0, 0.4]]), np.array([[0, 1.0, 0], [0, 3.0, 0]])
    bent = path.bend([10.0, 20.0], turns, ways)
    np.testing.assert_allclose(log_so3(bent.rotations)[:, 2], [0.2, 0.2, 0.4, 0.4], atol=1e-12)
    np.testing.assert_allclose(bent.centres[:, 1], [1, 1, 3, 3])
    np.testing.assert_allclose(path.bend([0.0, 30.0], turns, ways).centres[:, 1], [1, 5 / 3, 7 / 3, 3])
