"""Scores are zero for a perfect estimate, known for a known error, and equal to those of evo, scikit-image and the
streams' own scoring."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from evo.core import metrics
from evo.core.trajectory import PosePath3D
from numpy.typing import NDArray
from skimage.metrics import structural_similarity

from spiked.errors import ConfigurationError
from spiked.evaluate import (
    RPE_FRAMES,
    Similarity,
    best_gain,
    pose_errors,
    psnr,
    score_trajectory,
    score_views,
    similarity_of_poses,
    similarity_of_trajectories,
    ssim,
    umeyama,
)
from spiked.pose import exp_so3, quaternion
from spiked.trajectory import Trajectory

Array = NDArray[np.float64]
SHARED = Path(__file__).resolve().parents[2] / "shared"
SCORE = SHARED / "score" / "score.py"
needs_score = pytest.mark.skipif(not SCORE.exists(), reason="needs ../shared/score")

CARRY = Similarity(2.5, exp_so3(np.array([0.3, -1.2, 0.7])), np.array([4.0, -2.0, 9.0]))


def path(n: int = 200) -> tuple[Array, Array]:
    t = np.linspace(0, 1, n)
    centres = np.stack([np.sin(3 * t), t**2, 0.3 * np.cos(5 * t)], 1)
    return exp_so3(np.stack([0.2 * t, 0.5 * np.sin(2 * t), 0.1 * t], 1)), centres


def noisy(rotations: Array, centres: Array, seed: int = 0) -> tuple[Array, Array]:
    rng = np.random.default_rng(seed)
    turn = exp_so3(0.01 * rng.standard_normal(centres.shape))
    return rotations @ turn, centres + 0.02 * rng.standard_normal(centres.shape)


@pytest.fixture(scope="module")
def score() -> ModuleType:
    sys.path.insert(0, str(SCORE.parent))
    try:
        spec = importlib.util.spec_from_file_location("stream_score", SCORE)
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(SCORE.parent))
    return module


@pytest.mark.parametrize("carry", [Similarity(1.0, np.eye(3), np.zeros(3)), CARRY], ids=["same", "other world"])
def test_the_truth_in_any_world_has_no_error(carry: Similarity) -> None:
    rotations, centres = path()
    errors = pose_errors(truth=(rotations, centres), estimate=carry.poses(rotations, centres))
    assert errors.ate_percent < 1e-9
    assert errors.ate_unit < 1e-12
    assert errors.rpe_r_deg < 1e-5
    assert errors.rpe_t_percent < 1e-9


def test_a_known_turn_between_frames_is_found() -> None:
    _, centres = path()
    drift = exp_so3(np.outer(np.arange(200), [0, 0, np.radians(0.01)]))
    errors = pose_errors(truth=(np.tile(np.eye(3), (200, 1, 1)), centres), estimate=(drift, centres))
    assert errors.rpe_r_deg == pytest.approx(0.32, rel=1e-6)
    assert errors.ate_percent < 1e-9


def test_isotropic_noise_shows_as_its_share_of_the_radius() -> None:
    rotations, centres = path(4000)
    radius = np.sqrt(((centres - centres.mean(0)) ** 2).sum(1).mean())
    wrong = centres + 0.01 * radius * np.random.default_rng(1).standard_normal(centres.shape)
    assert pose_errors(truth=(rotations, centres), estimate=(rotations, wrong)).ate_percent == pytest.approx(
        np.sqrt(3), rel=0.03
    )


def test_a_camera_that_never_moves_scores_as_documented() -> None:
    rotations, centres = path()
    assert pose_errors(
        truth=(rotations, centres), estimate=(rotations, np.zeros_like(centres))
    ).ate_unit == pytest.approx(0.2041, abs=1e-4)


def test_a_truth_that_never_moves_is_refused() -> None:
    rotations, centres = path()
    with pytest.raises(ConfigurationError, match="never moves"):
        pose_errors(truth=(rotations, np.ones_like(centres)), estimate=(rotations, centres))


def test_a_straight_path_is_carried_over_by_its_orientations() -> None:
    rotations, _ = path()
    centres = np.outer(np.linspace(0, 1, 200), [1.0, 2.0, 0.5])
    found = similarity_of_poses(truth=(rotations, centres), estimate=CARRY.poses(rotations, centres))
    assert found.scale == pytest.approx(CARRY.scale)
    assert np.allclose(found.rotation, CARRY.rotation)
    assert np.allclose(found.translation, CARRY.translation)


def test_a_mirrored_cloud_is_never_matched_by_a_mirror() -> None:
    points = np.random.default_rng(0).standard_normal((50, 3))
    assert np.linalg.det(umeyama(source=points, target=points * [1, 1, -1]).rotation) == pytest.approx(1)


def test_relative_errors_are_over_the_same_frames_with_a_hole() -> None:
    """The same turn too much in each frame: pairs across the hole would show the turn of all that is missing."""
    n, rate = 400, 0.01
    t = np.arange(n) / 1000
    truth = Trajectory(t, exp_so3(np.outer(t, [0.0, 9.0, 0.0])), np.stack([np.sin(9 * t), t, t**2], 1))
    off = Trajectory(t, exp_so3(np.outer(t, [0.0, 9.0 * (1 + rate), 0.0])), truth.centres)
    holed = np.r_[0:40, 360:n]
    whole = score_trajectory(truth=truth, estimate=off, frame_rate_hz=1000)
    part = score_trajectory(
        truth=truth, estimate=Trajectory(t[holed], off.rotations[holed], off.centres[holed]), frame_rate_hz=1000
    )
    assert whole.errors is not None and part.errors is not None and part.coverage == pytest.approx(0.2)
    assert whole.errors.rpe_r_deg == pytest.approx(np.degrees(9 * rate * RPE_FRAMES / 1000), rel=1e-6)
    assert part.errors.rpe_r_deg == pytest.approx(whole.errors.rpe_r_deg, rel=1e-6)


def test_coverage_counts_frames_by_time() -> None:
    rotations, centres = path()
    times = (np.arange(200) + 0.5) / 20000
    truth = Trajectory(times, rotations, centres)
    half = Trajectory(times[50:150] + 0.2 / 20000, rotations[50:150], centres[50:150])
    result = score_trajectory(truth=truth, estimate=half, frame_rate_hz=20000)
    assert result.coverage == 0.5
    assert result.errors is not None and result.errors.ate_percent < 1e-9
    few = Trajectory(times[:20], rotations[:20], centres[:20])
    assert score_trajectory(truth=truth, estimate=few, frame_rate_hz=20000).errors is None
    elsewhere = Trajectory(times + 1, rotations, centres)
    with pytest.raises(ConfigurationError, match="time stamps"):
        similarity_of_trajectories(truth=truth, estimate=elsewhere, frame_rate_hz=20000)


def test_truth_and_estimate_cannot_be_swapped_unnoticed() -> None:
    rotations, centres = path()
    truth = Trajectory((np.arange(200) + 0.5) / 20000, rotations, centres)
    for function in (score_trajectory, similarity_of_trajectories, pose_errors, similarity_of_poses, umeyama):
        with pytest.raises(TypeError, match="positional"):
            function(truth, truth)
    assert best_gain([0.5 * centres], truths=[centres]) == pytest.approx(2)


def test_known_differences_have_known_psnr() -> None:
    image = np.full((20, 30), 0.5)
    assert psnr(image + 0.1, image) == pytest.approx(20)
    assert psnr(image, image) == pytest.approx(120)
    assert ssim(image, image) == pytest.approx(1)
    assert best_gain([0.25 * image], truths=[image]) == pytest.approx(4)


def test_a_view_with_a_small_pose_error_is_refined_to_the_truth() -> None:
    """A plane of blobs at depth 2, drawn analytically: without refinement the score would be the similarity's."""

    def render(rotation: Array, centre: Array) -> NDArray[np.float32]:
        y, x = np.mgrid[0:40, 0:60] + 0.5
        rays = np.stack([(x - 30) / 50, (y - 20) / 50, np.ones_like(x)], -1) @ rotation.T
        points = centre + rays * ((2 - centre[2]) / rays[..., 2])[..., None]
        shade = 0.5 + 0.2 * np.sin(9 * points[..., 0] + 4 * points[..., 1]) + 0.2 * np.cos(11 * points[..., 1])
        return np.asarray(shade, np.float32)

    truth = (np.eye(3), np.zeros(3))
    wrong = (exp_so3(np.array([0.004, -0.006, 0.01])), np.array([0.01, 0.0, 0.0]))
    picture = (0.5 * render(*truth)).astype(np.float32)
    plain = score_views(render, poses=[wrong], truths=[picture], length=2.0, refine=False)
    refined = score_views(render, poses=[wrong], truths=[picture], length=2.0)
    assert plain.mean_psnr_db < 40
    assert refined.mean_psnr_db > 60
    assert refined.gain == pytest.approx(0.5, rel=1e-3)
    assert refined.mean_ssim > 0.9999


def test_ate_and_rpe_are_those_of_evo() -> None:
    rotations, centres = path()
    moved, places = noisy(*CARRY.poses(rotations, centres))
    ours = pose_errors(truth=(rotations, centres), estimate=(moved, places))
    truth = PosePath3D(positions_xyz=centres, orientations_quat_wxyz=quaternion(rotations))
    estimate = PosePath3D(positions_xyz=places, orientations_quat_wxyz=quaternion(moved))
    estimate.align(truth, correct_scale=True)
    ate = metrics.APE(metrics.PoseRelation.translation_part)
    ate.process_data((truth, estimate))
    radius = np.sqrt(((centres - centres.mean(0)) ** 2).sum(1).mean())
    assert ours.ate_percent == pytest.approx(100 * ate.get_statistic(metrics.StatisticsType.rmse) / radius, rel=1e-9)
    for relation, figure in (
        (metrics.PoseRelation.rotation_angle_deg, ours.rpe_r_deg),
        (metrics.PoseRelation.translation_part, ours.rpe_t_percent * radius / 100),
    ):
        rpe = metrics.RPE(relation, delta=RPE_FRAMES, delta_unit=metrics.Unit.frames, all_pairs=True)
        rpe.process_data((truth, estimate))
        assert figure == pytest.approx(rpe.get_statistic(metrics.StatisticsType.mean), rel=1e-9)


def test_the_figures_of_unit_norm_are_those_of_evo() -> None:
    """24 poses of paths of unit norm, from each to the next, as the tables of CF-3DGS and InstantSplat have them."""
    rotations, centres = path()
    moved, places = noisy(*CARRY.poses(rotations, centres))
    ours = pose_errors(truth=(rotations, centres), estimate=(moved, places))
    rows = np.linspace(0, 199, 24).round().astype(int)
    truth, estimate = (
        PosePath3D(
            positions_xyz=(c[rows] - c[rows].mean(0)) / np.linalg.norm(c[rows] - c[rows].mean(0)),
            orientations_quat_wxyz=quaternion(r[rows]),
        )
        for r, c in ((rotations, centres), (moved, places))
    )
    estimate.align(truth, correct_scale=True)
    ate = metrics.APE(metrics.PoseRelation.translation_part)
    ate.process_data((truth, estimate))
    assert ours.ate_unit == pytest.approx(ate.get_statistic(metrics.StatisticsType.rmse), rel=1e-9)
    for relation, figure in (
        (metrics.PoseRelation.rotation_angle_deg, ours.rpe_r_unit_deg),
        (metrics.PoseRelation.translation_part, ours.rpe_t_unit / 100),
    ):
        rpe = metrics.RPE(relation, delta=1, delta_unit=metrics.Unit.frames)
        rpe.process_data((truth, estimate))
        assert figure == pytest.approx(rpe.get_statistic(metrics.StatisticsType.mean), rel=1e-9)


@pytest.mark.parametrize("shape", [(40, 60), (40, 60, 3)], ids=["grey", "colour"])
def test_ssim_is_that_of_scikit_image(shape: tuple[int, ...]) -> None:
    """scikit-image leaves out a margin of 5 px in its mean, so the image's own margin is a mirror image there."""
    rng = np.random.default_rng(3)
    image = rng.random(shape)
    other = np.clip(image + 0.1 * rng.standard_normal(shape), 0, 1)
    margin = [(5, 5), (5, 5), (0, 0)][: len(shape)]
    theirs = structural_similarity(
        *(np.pad(one, margin, mode="symmetric") for one in (other, image)),
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        channel_axis=2 if len(shape) == 3 else None,
    )
    assert ssim(other, image) == pytest.approx(theirs, abs=1e-9)


@needs_score
def test_pose_figures_are_those_of_the_scoring_script(score: ModuleType) -> None:
    truth = Trajectory.read_tum(SHARED / "streams" / "living" / "groundtruth.tum")
    rotations, centres = noisy(*CARRY.poses(truth.rotations, truth.centres))
    estimate = Trajectory(truth.times_s, rotations, centres)
    ours = pose_errors(truth=(truth.rotations, truth.centres), estimate=(rotations, centres))
    theirs = score.pose_errors(truth.matrices(), estimate.matrices())
    assert ours.ate_percent == pytest.approx(theirs["ate_percent"], abs=1e-6)
    assert ours.ate_unit == pytest.approx(theirs["ate_unit_24"], abs=1e-6)
    assert ours.rpe_r_deg == pytest.approx(theirs["rpe_r_deg"], abs=1e-6)
    assert ours.rpe_t_percent == pytest.approx(theirs["rpe_t_percent"], abs=1e-6)
    scale, rotation, translation = score.similarity_to_estimate(truth.matrices(), estimate.matrices())
    found = similarity_of_trajectories(truth=truth, estimate=estimate, frame_rate_hz=20000)
    assert found.scale == pytest.approx(scale)
    assert np.allclose(found.rotation, rotation)
    assert np.allclose(found.translation, translation)


@needs_score
@pytest.mark.parametrize("shape", [(40, 60), (40, 60, 3)], ids=["grey", "colour"])
def test_ssim_is_that_of_the_scoring_script(score: ModuleType, shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(3)
    image = rng.random(shape)
    other = np.clip(image + 0.1 * rng.standard_normal(shape), 0, 1)
    assert ssim(other, image) == pytest.approx(score.ssim(other, image), abs=1e-9)
