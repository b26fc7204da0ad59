"""A lens with distortion in tracks, poses, points, warps and the map."""

from dataclasses import replace

import numpy as np
import pytest
import spiked.native._bundle as _bundle
import spiked.native._dense as _dense

from spiked.distortion import Distortion, LensModel
from spiked.evaluate import score_trajectory
from spiked.pose import exp_so3
from spiked.recon import Options, Reconstructor
from spiked.recon.mapping.frame_warp import FrameWarp
from spiked.recon.mapping.pruning import Pruning
from spiked.recon.odometry.bundle_adjustment import Bundle
from spiked.recon.odometry.initialisation import Views, bootstrap
from spiked.recon.odometry.normal_equations import FreeOptics, PoseBlocks
from spiked.recon.odometry.pnp import draw_pose, solve_pose
from spiked.recon.odometry.sparse_map import Pose
from spiked.render import Camera
from spiked.render.charge import WARP_CELL_PX
from spiked.sensor import Intrinsics, Sensor
from spiked.simulate import MotionKind, SimulatedCamera
from spiked.trajectory import Trajectory

BARREL = Intrinsics(346.0, 350.0, 203.0, 122.0, Distortion(LensModel.OPENCV, (-0.3, 0.1, 0.004, -0.003)))
FISHEYE = Intrinsics(191.0, 192.0, 203.0, 122.0, Distortion(LensModel.FISHEYE, (0.03, -0.01)))
LENSES = pytest.mark.parametrize("k", [BARREL, FISHEYE], ids=["barrel", "fisheye"])


def tracks(k: Intrinsics, noise_px: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Tracks [10, 150, 2] all over the image of a moving camera, with its rotations, centres and the points."""
    rng = np.random.default_rng(0)
    rays = k.unproject(rng.uniform([10, 10], [390, 240], (150, 2)))
    points = rays * rng.uniform(0.8, 2.0, (150, 1))
    s = np.linspace(0, 1, 10)[:, None]
    rotations, centres = exp_so3(0.1 * s * [0.3, -1.0, 0.4]), 0.15 * s * [1.0, 0.3, 0.1]
    local = np.einsum("vji,vpj->vpi", rotations, points[None] - centres[:, None])
    return k.project(local) + rng.normal(scale=noise_px, size=(10, 150, 2)), rotations, centres, points


@LENSES
def test_bundle_adjustment_finds_poses_and_points(k: Intrinsics) -> None:
    pixels, rotations, centres, points = tracks(k, 0.0)
    rng = np.random.default_rng(1)
    camera, point = np.divmod(np.arange(1500), 150)
    turned = exp_so3(rng.normal(0, 2e-3, (10, 3))) @ rotations
    start = points * rng.uniform(0.98, 1.02, (150, 1))
    bundle = Bundle(turned, centres + rng.normal(0, 2e-3, (10, 3)), start, camera, point, pixels.reshape(-1, 2), k)
    bundle.rotations[:2], bundle.centres[:2] = rotations[:2], centres[:2]
    fixed = np.arange(10) < 2
    bundle.optimise(50, 0.3, fixed, tolerance=1e-12)
    assert np.abs(bundle.residuals()).max() < 1e-4
    assert np.abs(bundle.points - points).max() < 1e-3
    bundle.intrinsics = k.pinhole
    assert np.abs(bundle.residuals()).max() > 1


@LENSES
def test_the_first_map_is_found(k: Intrinsics) -> None:
    pixels, rotations, _, _ = tracks(k, 0.05)
    result = bootstrap(Views(pixels, np.arange(150), k))
    assert result.winner is not None, result.reason
    assert result.winner.noise_px() < 0.07
    assert np.abs(result.winner.bundle.rotations[-1] @ rotations[-1].T - np.eye(3)).max() < 0.01


@LENSES
def test_a_pose_is_found_from_points(k: Intrinsics) -> None:
    pixels, rotations, centres, points = tracks(k, 0.0)
    start = Pose(rotations[4], centres[4])
    solved = solve_pose(points, np.ascontiguousarray(pixels[5]), k, start, (2.0, 1.0, 0.3, 0.3, 0.3))
    assert np.abs(solved.pose.rotation - rotations[5]).max() < 1e-6
    assert np.abs(solved.pose.centre - centres[5]).max() < 1e-6
    drawn = draw_pose(points, np.ascontiguousarray(pixels[5]), k)
    assert drawn is not None and drawn[1] == 150
    assert np.abs(drawn[0].centre - centres[5]).max() < 1e-3


@LENSES
def test_tracks_are_placed_where_their_rays_meet(k: Intrinsics) -> None:
    pixels, rotations, centres, points = tracks(k, 0.0)
    view, track = np.divmod(np.arange(1500), 150)
    found = np.full((150, 3), np.nan)
    seen = (rotations, centres, view, track, pixels.reshape(-1, 2), k.fx, k.fy, k.cx, k.cy, 5, 0.5, 2.0)
    _bundle.triangulate(*seen, found, **k.lens())
    known = np.isfinite(found[:, 0])
    assert known.mean() > 0.9 and np.abs(found - points)[known].max() < 1e-6


@LENSES
def test_a_pixel_moves_the_pose_as_its_projection_says(k: Intrinsics) -> None:
    rotation, centre = exp_so3(np.array([0.05, -0.1, 0.2])), np.array([0.1, 0.05, -0.1])
    images = [np.zeros((250, 400), np.float32) for _ in range(5)]
    error, du, dv, depth, weight = images
    row, column = 230, 20
    error[row, column], weight[row, column] = 1, 1
    du[row, column], dv[row, column], depth[row, column] = 0.7, -0.4, 1.5
    pose, keys, places = np.empty((6, 7)), np.empty(4, np.int64), np.empty((4, 3, 10))
    lens = (k.fx, k.fy, k.cx, k.cy)
    _dense.photometric_normals(*images, *lens, rotation, centre, 0.1, pose, keys, places, **k.lens())
    point = centre + rotation @ (1.5 * k.unproject(np.array([column + 0.5, row + 0.5])))

    def image(change: np.ndarray) -> float:
        turned = exp_so3(change[:3]) @ rotation
        at = k.project((point - centre - change[3:]) @ turned)
        return float(0.7 * at[0] - 0.4 * at[1])

    numeric = [(image(1e-6 * step) - image(-1e-6 * step)) / 2e-6 for step in np.eye(6)]
    np.testing.assert_allclose(pose[:, 6], -np.array(numeric), rtol=1e-5, atol=1e-5)  # the point carries its colour


@LENSES
def test_nodes_are_led_to_where_they_are_seen_from_another_pose(k: Intrinsics) -> None:
    camera, depth = Camera(k, 400, 250), np.full((250, 400), 2.0, np.float32)
    rotations = exp_so3(np.array([[0.004, -0.006, 0.005], [-0.01, 0.0, 0.004]]))
    centres = np.array([[0.01, 0.005, 0.0], [-0.02, 0.01, 0.0]])
    moved = FrameWarp(np.zeros((2, 1), np.uint8), rotations, centres).displacements(
        camera, np.eye(3), np.zeros(3), depth
    )
    rows, columns = moved.shape[1:3]
    grid = WARP_CELL_PX * np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), -1).astype(float)
    inner = ((grid > 8) & (grid < [392, 242])).all(-1)
    for rotation, centre, field in zip(rotations, centres, moved, strict=True):
        rays = k.unproject(grid) @ rotation.T
        onto = centre + rays * ((2.0 - centre[2]) / rays[..., 2:])
        assert np.abs(field - (k.project(onto) - grid))[inner].max() < 0.02


@LENSES
def test_a_room_is_reconstructed_through_a_lens(k: Intrinsics) -> None:
    half = k.scaled(0.5)
    small = Intrinsics(half.fx, half.fx, 100.0, 64.0, half.distortion)
    sensor = Sensor(200, 128, 20_000.0, intrinsics=small)
    camera = SimulatedCamera(sensor, seed=2, motion=MotionKind.ARC, flow_px=0.2, parallax=0.4, threads=2)
    frames, count = camera.next_frames(400), np.arange(400)
    truth = Trajectory((count + 0.5) / 20_000.0, *camera.truth(count))
    reconstructor = Reconstructor(sensor, Options(steps=150))
    reconstructor.feed(0, frames)
    reconstructor.finish()
    score = score_trajectory(truth=truth, estimate=reconstructor.trajectory(), frame_rate_hz=20_000.0)
    assert score.errors is not None and score.errors.ate_percent < 1.0
    views = [reconstructor.views.image(i) for i in reconstructor.views.spread(reconstructor.views.kept, 4)]
    path = reconstructor.path
    assert path is not None
    scene, widest = reconstructor.scene(), Pruning().widest
    for view in views:
        (rotation,), (centre,) = path.poses([view.time])
        distance = np.linalg.norm(scene.means - centre, axis=1)
        assert (np.exp(scene.log_scales.max(1)) < 1.5 * widest * distance).all()
        shown = reconstructor.view(rotation, centre)[..., 0]
        assert np.corrcoef(shown.ravel(), view.rate.ravel())[0, 1] > 0.9
    assert reconstructor.report()["distortion"]["k1"] == k.distortion.coefficients[0]  # type: ignore[index, union-attr]


def test_the_adjustment_moves_as_a_free_lens_says() -> None:
    """Normal equations of the focal length, k1 and k2 against differences of the residuals."""
    pixels, rotations, centres, points = tracks(BARREL, 0.05)
    camera, point = np.divmod(np.arange(1500), 150)
    free = FreeOptics(focal=True, radial=True)
    bundle = Bundle(rotations, centres, points, camera, point, pixels.reshape(-1, 2), BARREL, free)
    fixed, step = PoseBlocks.of_poses(np.zeros(10, bool)), 1e-6
    system = bundle.linearise(1e6, fixed)
    moved = [replace(bundle, intrinsics=free.moved(BARREL, step * unit)).residuals() for unit in np.eye(3)]
    by_optics = (np.stack(moved, -1) - bundle.residuals()[..., None]).reshape(-1, 3) / step
    np.testing.assert_allclose(system.hessian, by_optics.T @ by_optics, rtol=1e-4)
    np.testing.assert_allclose(system.gradient, by_optics.T @ bundle.residuals().ravel(), rtol=1e-3)


def moved_through(small: Intrinsics) -> tuple[Sensor, np.ndarray, Trajectory]:
    """400 frames of a camera that moves sideways in the built-in room, and its path."""
    sensor = Sensor(200, 128, 20_000.0, intrinsics=small)
    camera = SimulatedCamera(sensor, seed=2, motion=MotionKind.ARC, flow_px=0.2, parallax=0.4, threads=2)
    count = np.arange(400)
    return sensor, camera.next_frames(400), Trajectory((count + 0.5) / 20_000.0, *camera.truth(count))


def tracked(sensor: Sensor, frames: np.ndarray) -> Reconstructor:
    reconstructor = Reconstructor(sensor, Options(steps=0))
    reconstructor.feed(0, frames)
    reconstructor.finish()
    return reconstructor


@pytest.mark.parametrize("focal_known", [True, False], ids=["focal", "nothing"])
@LENSES
def test_a_lens_that_nobody_stated_is_found_and_said(k: Intrinsics, focal_known: bool) -> None:
    assert k.distortion is not None
    radial = Distortion(k.distortion.model, k.distortion.coefficients[:2])
    small = Intrinsics(0.5 * k.fx, 0.5 * k.fx, 100.0, 64.0, radial)
    sensor, frames, truth = moved_through(small)
    errors = []
    for known in (sensor, replace(sensor, intrinsics=small.pinhole if focal_known else None)):
        reconstructor = tracked(known, frames)
        score = score_trajectory(truth=truth, estimate=reconstructor.trajectory(), frame_rate_hz=20_000.0)
        assert score.errors is not None
        errors.append(score.errors.ate_percent)
    assert errors[1] < 2 * errors[0]
    found = reconstructor.camera.intrinsics
    middle = np.stack(np.meshgrid(np.linspace(30, 170, 8), np.linspace(20, 108, 6)), -1)
    rays = [one.unproject(middle) for one in (small, found)]
    assert np.abs(small.project(rays[1]) - small.project(rays[0])).max() < 2
    assert any("the lens distorts, which was not given and was estimated" in line for line in reconstructor.warnings)
    assert "the lens distorts" in reconstructor.status().reason
    report = reconstructor.report()
    assert report["distortion_estimated"] and report["distortion_corner_sigma_px"] is not None


def test_a_camera_without_distortion_is_not_given_one() -> None:
    sensor, frames, _ = moved_through(Intrinsics(173.0, 173.0, 100.0, 64.0))
    reconstructor = tracked(sensor, frames)
    assert reconstructor.odometry.lens is None and reconstructor.camera.intrinsics.distortion is None
    assert reconstructor.report()["distortion_estimated"] is False
