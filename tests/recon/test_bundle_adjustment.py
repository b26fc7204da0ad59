"""The compiled normal equations are those of all unknowns together, points included."""

import numpy as np
import pytest

from spiked.pose import exp_so3
from spiked.recon.odometry.bundle_adjustment import Bundle
from spiked.recon.odometry.normal_equations import FreeOptics, PoseBlocks
from spiked.sensor import Intrinsics
from spiked.spline import Spline

K = Intrinsics.from_fov(400, 250, 60)
CAMERAS, POINTS = 6, 25
SCALE_PX = 0.7


def bundle(free: FreeOptics) -> tuple[Bundle, Spline, np.ndarray]:
    """Poses on a spline, and noisy sights of points, some of which are missing."""
    rng = np.random.default_rng(3)
    times = np.linspace(0, 40, CAMERAS)
    rotations = exp_so3(np.outer(times, [0.001, 0.002, -0.001]))
    centres = np.outer(times, [0.004, 0.001, 0.002])
    spline = Spline.fit(times, rotations, centres, 20, span=(0, 40))
    rotations, centres = spline.poses(times)
    points = np.column_stack([rng.uniform(-0.4, 0.4, (POINTS, 2)), rng.uniform(0.8, 2, POINTS)])
    camera, point = np.divmod(np.arange(CAMERAS * POINTS), POINTS)
    seen = rng.random(len(camera)) < 0.8
    camera, point = camera[seen], point[seen]
    local = np.einsum("mji,mj->mi", rotations[camera], points[point] - centres[camera])
    pixels = local[:, :2] / local[:, 2:] * K.fx + [K.cx, K.cy] + rng.normal(scale=0.3, size=(len(camera), 2))
    return Bundle(rotations, centres, points, camera, point, pixels, K, free), spline, times


def moved(b: Bundle, unknown: np.ndarray) -> np.ndarray:
    """Residuals [2 M] with poses, points and free optics moved by [6 C + 3 P + n]."""
    poses, rest = unknown[: 6 * CAMERAS].reshape(-1, 6), unknown[6 * CAMERAS :]
    points, optics = rest[: 3 * POINTS].reshape(-1, 3), rest[3 * POINTS :]
    other = Bundle(
        exp_so3(poses[:, :3]) @ b.rotations,
        b.centres + poses[:, 3:],
        b.points + points,
        b.camera,
        b.point,
        b.pixels,
        b.free.moved(K, optics),
    )
    return other.residuals().ravel()


@pytest.mark.parametrize("radial", [False, True])
@pytest.mark.parametrize("focal", [False, True])
@pytest.mark.parametrize("by_knots", [False, True])
def test_a_step_is_the_one_of_a_dense_solver(focal: bool, radial: bool, by_knots: bool) -> None:
    b, spline, times = bundle(FreeOptics(focal, radial))
    optics = b.free.count
    damping = 1e-2
    free = np.arange(CAMERAS) > 0
    blocks = PoseBlocks.of_knots(spline, times) if by_knots else PoseBlocks.of_poses(free)
    step = b.linearise(SCALE_PX, blocks, damping).solve(damping)

    size = 6 * CAMERAS + 3 * POINTS + optics
    jacobian = np.stack([(moved(b, h) - moved(b, -h)) / 2e-6 for h in 1e-6 * np.eye(size)], 1)
    error = b.residuals()
    weight = np.repeat(1 / (1 + ((error / SCALE_PX) ** 2).sum(1)), 2)
    pieces = spline.basis_matrix(times) if by_knots else np.eye(CAMERAS)[:, free]
    poses = np.einsum("mci,ck->mki", jacobian[:, : 6 * CAMERAS].reshape(-1, CAMERAS, 6), pieces).reshape(
        len(weight), -1
    )
    landmarks, last = np.split(jacobian[:, 6 * CAMERAS :], [3 * POINTS], 1)
    dense = np.concatenate([poses, last, landmarks], 1)
    hessian = dense.T @ (weight[:, None] * dense)
    hessian[np.diag_indices(len(hessian))] *= 1 + damping
    hessian[np.diag_indices(len(hessian))] += 1e-9
    solution = -np.linalg.solve(hessian, dense.T @ (weight * error.ravel()))
    n = poses.shape[1]
    assert step.blocks.ravel() == pytest.approx(solution[:n], rel=1e-4, abs=1e-7)
    assert step.points.ravel() == pytest.approx(solution[n + optics :], rel=1e-4, abs=1e-6)
    assert step.optics == pytest.approx(solution[n : n + optics], rel=1e-4, abs=1e-7)


def test_a_point_behind_its_camera_pulls_at_nothing() -> None:
    b, _, _ = bundle(FreeOptics())
    first = b.point[0]
    b.points[first] = [0, 0, -1]
    hidden = b.point == first
    assert np.isinf(b.residuals()[hidden]).all() and np.isfinite(b.residuals()[~hidden]).all()
    assert np.isfinite(b.pose_hessians(SCALE_PX)).all()
    assert b.cost(SCALE_PX) > 0.4


def test_observations_of_nothing_are_refused() -> None:
    b, _, _ = bundle(FreeOptics())
    b.point = b.point + POINTS
    with pytest.raises(ValueError, match="does not exist"):
        b.residuals()
