"""The focal length is found where nobody says it, and how sure it is is told."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from spiked.evaluate import score_trajectory
from spiked.pose import exp_so3
from spiked.recon import Options, Reconstructor, State
from spiked.recon.odometry.bundle_adjustment import Bundle
from spiked.recon.odometry.initialisation import LeastParallax, Views
from spiked.recon.odometry.normal_equations import FreeOptics
from spiked.recon.odometry.self_calibration import MAX_FOCAL_SIGMA, Focal, try_optics
from spiked.recording import open_recording
from spiked.sensor import Intrinsics, Sensor
from spiked.simulate import MotionKind, SimulatedCamera
from spiked.trajectory import Trajectory

K = Intrinsics.from_fov(400, 250, 50)
GUESS = Intrinsics.from_fov(400, 250, 60)


def tracks(turn_rad: float, way: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Tracks [10, 150, 2] of a camera that turns and moves, with its rotations, centres and the points."""
    rng = np.random.default_rng(0)
    points = rng.uniform([-0.6, -0.4, 0.8], [0.6, 0.4, 2.0], (150, 3)) * [1, 1, 1]
    s = np.linspace(0, 1, 10)[:, None]
    rotations = exp_so3(turn_rad * s * [0.3, -1.0, 0.4])
    centres = way * s * [1.0, 0.3, 0.1]
    local = np.einsum("vji,vpj->vpi", rotations, points[None] - centres[:, None])
    pixels = local[..., :2] / local[..., 2:] * K.fx + [K.cx, K.cy]
    return pixels + rng.normal(scale=0.05, size=pixels.shape), rotations, centres, points


def test_adjustment_finds_the_focal_length() -> None:
    pixels, rotations, centres, points = tracks(0.25, 0.3)
    camera, point = np.divmod(np.arange(pixels.shape[0] * pixels.shape[1]), pixels.shape[1])
    bundle = Bundle(rotations, centres, points, camera, point, pixels.reshape(-1, 2), GUESS, FreeOptics(focal=True))
    bundle.optimise(60, 0.3, tolerance=1e-7)
    sigma = float(np.sqrt(bundle.optics_covariance(0.3)[0, 0]))
    assert bundle.intrinsics.fx == pytest.approx(K.fx, rel=max(5 * sigma, 1e-3))
    assert sigma < 0.01 and bundle.noise_px() < 0.07


def test_the_first_map_is_found_without_a_focal_length() -> None:
    pixels, *_ = tracks(0.25, 0.3)
    verdict, found = try_optics(Views(pixels, np.arange(pixels.shape[1]), GUESS), 0, LeastParallax(0.8), False)
    assert verdict.winner is not None, verdict.reason
    assert found.fx == pytest.approx(K.fx, rel=0.03)


def test_turning_with_an_unknown_focal_length_is_not_taken_for_moving() -> None:
    pixels, *_ = tracks(0.15, 0.0)
    verdict, _ = try_optics(Views(pixels, np.arange(pixels.shape[1]), GUESS), 0, LeastParallax(1.2), False)
    assert verdict.winner is None and verdict.needs_motion and "parallax" in verdict.reason


def test_a_recording_without_a_focal_length_is_reconstructed_and_the_user_told() -> None:
    known = Sensor(240, 160, 20000.0, intrinsics=Intrinsics.from_fov(240, 160, 50))
    camera = SimulatedCamera(known, seed=2, motion=MotionKind.ARC, flow_px=0.3, parallax=0.5)
    frames, k = camera.next_frames(480), np.arange(480)
    truth = Trajectory((k + 0.5) / 20000.0, *camera.truth(k))
    reconstructor = Reconstructor(replace(known, intrinsics=None), Options(steps=20))
    for first in range(0, 480, 40):
        reconstructor.feed(first, frames[first : first + 40])
        reconstructor.improve(0.01)
    reconstructor.finish()
    assert reconstructor.status().state is State.TRACK, reconstructor.status().reason
    score = score_trajectory(truth=truth, estimate=reconstructor.trajectory(), frame_rate_hz=20000.0)
    assert score.errors is not None and score.errors.ate_percent < 3.0
    assert known.intrinsics is not None
    assert reconstructor.camera.intrinsics.fx == pytest.approx(known.intrinsics.fx, rel=0.03)
    assert reconstructor.sensor.intrinsics == reconstructor.camera.intrinsics
    (warning,) = reconstructor.warnings
    assert "estimated" in warning and "--fov" in warning
    report = reconstructor.report()
    assert report["focal_estimated"] is True and report["focal_px"][0] > 0  # type: ignore[index]


def test_a_path_is_degraded_where_the_focal_length_is_hardly_known() -> None:
    known = Sensor(240, 160, 20000.0, intrinsics=Intrinsics.from_fov(240, 160, 50))
    camera = SimulatedCamera(known, seed=2, motion=MotionKind.ARC, flow_px=0.3, parallax=0.5)
    reconstructor = Reconstructor(replace(known, intrinsics=None), Options(steps=0))
    reconstructor.feed(0, camera.next_frames(200))
    reconstructor.finish()
    assert reconstructor.focal is not None and reconstructor.focal.relative_sigma > MAX_FOCAL_SIGMA
    status = reconstructor.status()
    assert status.state is State.DEGRADED and "depend on a focal length only known to about" in status.reason


def test_a_real_recording_that_does_not_show_its_focal_length_is_degraded(shared: Path) -> None:
    recording = open_recording(shared / "real" / "reds_arcade.dat")
    reconstructor = Reconstructor(recording.sensor, Options(steps=0))
    reconstructor.feed(0, recording.read(0, recording.frames))
    reconstructor.finish()
    status = reconstructor.status()
    assert status.state is State.DEGRADED and "focal length that the recording does not determine" in status.reason


def test_an_unsure_focal_length_says_so() -> None:
    assert "more than 100%" in str(Focal(K, np.inf)) and "2.0%" in str(Focal(K, 0.02))


@pytest.mark.slow
def test_living_without_its_focal_length(shared: Path) -> None:
    """Within 3 %, and the path is no more than twice as far off."""
    folder = shared / "streams" / "living"
    recording = open_recording(folder / "living.dat")
    truth = Trajectory.read_tum(folder / "groundtruth.tum")
    errors = []
    for sensor in (recording.sensor, replace(recording.sensor, intrinsics=None)):
        reconstructor = Reconstructor(sensor, Options(steps=0))
        for first in range(0, recording.frames, 64):
            reconstructor.feed(first, recording.read(first, min(64, recording.frames - first)))
        reconstructor.finish()
        score = score_trajectory(truth=truth, estimate=reconstructor.trajectory(), frame_rate_hz=sensor.frame_rate_hz)
        assert score.errors is not None
        errors.append(score.errors.ate_percent)
    assert recording.sensor.intrinsics is not None
    assert reconstructor.camera.intrinsics.fx == pytest.approx(recording.sensor.intrinsics.fx, rel=0.03)
    assert errors[1] < 2 * errors[0]
