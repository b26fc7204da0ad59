"""The methods and their parts: the paper's end to end, its pose gradient, mixtures with ours, and names."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from spiked_service.cli.main import app
from typer.testing import CliRunner

from spiked.errors import ConfigurationError
from spiked.evaluate import score_trajectory
from spiked.pose import exp_so3, log_so3
from spiked.recon import (
    METHODS,
    Initialisation,
    LossName,
    MapOptions,
    MethodName,
    Options,
    PoseStepName,
    Reconstructor,
)
from spiked.recon.alternation import continued
from spiked.recon.mapping.pose_steps import LONGEST_STEP, PoseGradient
from spiked.recon.untracked import UntrackedOdometry
from spiked.recording import open_recording
from spiked.sensor import Sensor
from spiked.simulate import MotionKind, SimulatedCamera
from spiked.spline import Spline
from spiked.trajectory import Trajectory

FRAMES = 320
MEASURE = Path(__file__).parents[2] / "evaluation" / "measure_methods.py"


class Room:
    """A short recording of the built-in room, and its true path."""

    def __init__(self) -> None:
        camera = SimulatedCamera(Sensor(160, 120, 20_000.0), seed=1, motion=MotionKind.ARC, flow_px=0.3)
        self.frames = camera.next_frames(FRAMES)
        self.sensor = replace(camera.sensor, intrinsics=camera.intrinsics)
        rotations, centres = camera.truth(np.arange(FRAMES))
        self.truth = Trajectory((np.arange(FRAMES) + 0.5) / self.sensor.frame_rate_hz, rotations, centres)

    def reconstruct(self, options: Options) -> Reconstructor:
        """Feed all frames and refine."""
        made = Reconstructor(self.sensor, options)
        made.feed(0, self.frames)
        made.finish()
        assert made.failure is None
        return made


@pytest.fixture(scope="module")
def room() -> Room:
    return Room()


@pytest.fixture(scope="module")
def known(room: Room) -> Reconstructor:
    """A map of the paper's method on the true poses."""
    return room.reconstruct(Options(steps=60, poses=room.truth, method=MethodName.NOPE_SGS))


@pytest.mark.parametrize("blur_matched", [False, True])
@pytest.mark.parametrize("difference", [False, True])
def test_the_pose_gradient_through_the_sub_frames_is_that_of_finite_differences(
    known: Reconstructor, difference: bool, blur_matched: bool
) -> None:
    trainer = known.trainer
    trainer.planner.blur_matched = blur_matched
    assert known.path is not None
    times = np.arange(1.0, FRAMES - 1)
    path = Spline.fit(times, *known.path.poses(times), 16, 1)
    ids = trainer.views.mappable(path)
    step, view_id = PoseGradient(trainer, 0, difference), ids[len(ids) // 2]
    path = path.move(*np.random.default_rng(0).normal(scale=2e-3, size=(2, len(path.centres), 3)))
    gradient = step.model(path, view_id).slope
    assert (np.abs(gradient).max(1) > 0).sum() >= 3
    for seed in range(3):
        direction = np.random.default_rng(seed).normal(size=gradient.shape) * 1e-4

        def moved(sign: int, direction: np.ndarray = direction) -> float:
            return step.model(path.move(sign * direction[:, :3], sign * direction[:, 3:]), view_id).loss

        assert (gradient * direction).sum() == pytest.approx((moved(1) - moved(-1)) / 2, rel=0.03)


def test_a_path_that_is_far_off_stays_finite(known: Reconstructor) -> None:
    """Half a radian: its views show nothing of what they should, and their curvature says nothing."""
    trainer = known.trainer
    assert known.path is not None
    times = np.arange(1.0, FRAMES - 1)
    path = Spline.fit(times, *known.path.poses(times), 16, 1)
    ids = trainer.views.mappable(path)
    path = path.move(*np.random.default_rng(0).normal(scale=0.5, size=(2, len(path.centres), 3)))
    step = PoseGradient(trainer, 0)
    for done in range(10):
        moved = step.improve(path, ids, 1, done / 10)
        assert np.abs(moved.centres - path.centres).max() <= LONGEST_STEP
        path = moved
    assert np.isfinite(path.rotations).all()


def test_the_method_of_the_paper_runs_without_tracks_and_poses(room: Room) -> None:
    made = room.reconstruct(Options(steps=160, method=MethodName.NOPE_SGS))
    assert isinstance(made.odometry, UntrackedOdometry) and len(made.odometry.points) == 0
    assert len(made.trajectory()) == FRAMES and len(made.scene()) > 1000
    moved = made.trajectory().centres
    assert np.isfinite(moved).all() and np.ptp(moved, 0).max() > 0
    report = made.report()
    assert report["options"]["method"] == "nope-sgs" and report["outcome"] == "complete"  # type: ignore[index]
    assert made.trainer.loss is LossName.ACCUMULATION_BINOMIAL


def test_steps_that_add_views_are_taken_from_those_asked_for(room: Room) -> None:
    made = room.reconstruct(Options(steps=80, method=MethodName.NOPE_SGS))
    assert 40 < made.trainer.mapper.steps < 60


def test_its_first_view_is_fitted_before_any_other(room: Room) -> None:
    """Flat, by the interval loss; then one view after the other at constant velocity."""
    made = room.reconstruct(Options(steps=0, method=MethodName.NOPE_SGS))
    assert made.trainer.loss is LossName.INTERVAL and np.allclose(made.scene().means[:, 2], 1)


def test_its_first_view_begins_at_the_depth_that_is_given(room: Room) -> None:
    size = room.sensor.height, room.sensor.width
    depth = np.where(np.arange(size[1]) < size[1] / 2, 2.0, 6.0) * np.ones(size)
    depth[:4] = np.nan
    made = room.reconstruct(Options(steps=0, method=MethodName.NOPE_SGS, first_depth=depth))
    means = made.scene().means
    known = np.median(np.where(np.isnan(depth), np.inf, depth)[4:])
    assert set(np.round(np.unique(means[:, 2]), 4)) <= set(np.round([2 / known, 1, 6 / known], 4))
    assert means[means[:, 2] < 0.99, 0].max() < means[means[:, 2] > 1.01, 0].min() + 0.2
    with pytest.raises(ConfigurationError, match=r"is \(2, 2\), expected"):
        room.reconstruct(Options(steps=0, method=MethodName.NOPE_SGS, first_depth=np.ones((2, 2))))


@pytest.mark.parametrize(
    "options",
    [
        Options(steps=60, method=MethodName.NOPE_SGS, loss=LossName.CHARGE, pose_step=PoseStepName.ALIGNMENT),
        Options(steps=60, method=MethodName.NOPE_SGS, mapping=MapOptions(sub_frames=2)),
        Options(steps=60, method=MethodName.NOPE_SGS, pose_step=PoseStepName.DIFFERENCE),
        Options(steps=100, pose_step=PoseStepName.GRADIENT, loss=LossName.BINOMIAL, window_frames=16),
    ],
    ids=["theirs with our parts", "theirs with fewer sub-frames", "theirs with differences", "ours with their parts"],
)
def test_parts_of_the_methods_are_mixed(room: Room, options: Options) -> None:
    given = options.method is MethodName.SPIKED
    made = room.reconstruct(replace(options, poses=room.truth if given else None))
    assert len(made.scene()) > 1000
    assert made.trainer.options.loss is (options.loss or LossName.ACCUMULATION_BINOMIAL)
    assert made.trainer.options.sub_frames == (None if given else options.mapping.sub_frames or 4)


@pytest.mark.slow
def test_the_pose_gradient_corrects_a_disturbed_path_of_living(shared: Path, tmp_path: Path) -> None:
    """0.2 degrees and 0.5 % of the radius: the table "A disturbed path" of docs/paper.md."""
    options = ("--only", "living", "--steps", "200", "--pose-steps", "250", "--window-frames", "64")
    command = [sys.executable, MEASURE, "poses", shared / "streams", *options, "--json", tmp_path / "rows.json"]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    rows = {row["what"]: row for row in json.loads((tmp_path / "rows.json").read_text())}
    assert (rows["disturbed"]["deg"], rows["disturbed"]["percent"]) == pytest.approx((0.2, 0.5), rel=0.05)
    gradient = rows["pose gradient, each render"]
    assert gradient["deg"] < 0.05 and gradient["percent"] < 0.3


@pytest.mark.slow
def test_the_method_of_the_paper_converges_from_tracks_on_living(shared: Path) -> None:
    """The table "from tracks" of docs/paper.md: 0.23 to 0.25 % with three seeds."""
    folder = shared / "streams" / "living"
    recording = open_recording(folder / "living.dat")
    options = Options(steps=600, method=MethodName.NOPE_SGS, initialisation=Initialisation.TRACKS)
    made = Reconstructor(recording.sensor, options, recording=recording)
    made.feed(0, recording.read(0, recording.frames))
    made.finish()
    truth = Trajectory.read_tum(folder / "groundtruth.tum")
    rate_hz = recording.sensor.frame_rate_hz
    score = score_trajectory(truth=truth, estimate=made.trajectory(), frame_rate_hz=rate_hz)
    assert score.coverage > 0.99 and score.errors is not None
    assert score.errors.ate_percent < 0.35


def test_a_path_is_continued_at_constant_velocity() -> None:
    count = 8
    turn, way = np.array([0.01, -0.02, 0.005]), np.array([0.1, 0.0, 0.02])
    rotations = exp_so3(np.arange(count)[:, None] * turn)
    path = Spline(0.0, 10.0, rotations, np.arange(count)[:, None] * way, 1)
    still = replace(path, rotations=rotations.copy(), centres=path.centres.copy())
    still.rotations[4:], still.centres[4:] = np.eye(3), 0
    made = continued(still, 25.0)
    np.testing.assert_allclose(made.centres, path.centres, atol=1e-12)
    np.testing.assert_allclose(log_so3(made.rotations @ rotations.swapaxes(1, 2)), 0, atol=1e-12)
    assert continued(path, 65.0) is path


def test_every_method_is_found_by_its_name_and_described() -> None:
    assert set(METHODS) == {*MethodName} and all(method.summary for method in METHODS.values())
    assert Options().parts == METHODS[MethodName.SPIKED] and Options().fitted == MapOptions()


def test_unknown_names_and_impossible_mixtures_are_refused(room: Room, tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="no method 'nerf': choose one of spiked, nope-sgs"):
        Options(method="nerf")  # type: ignore[arg-type]
    with pytest.raises(ConfigurationError, match="needs a path before its map"):
        Options(initialisation=Initialisation.PROGRESSIVE)
    with pytest.raises(ConfigurationError, match="grows with its map"):
        Options(first_depth=np.ones((2, 2)))
    with pytest.raises(ConfigurationError, match="no value that is positive"):
        Options(method=MethodName.NOPE_SGS, first_depth=np.zeros((2, 2)))
    with pytest.raises(ConfigurationError, match="no tracks to estimate it from: give --fov"):
        Reconstructor(replace(room.sensor, intrinsics=None), Options(method=MethodName.NOPE_SGS))
    done = CliRunner().invoke(app, ["reconstruct", "rec.dat", "-o", str(tmp_path / "out"), "--method", "nerf"])
    assert done.exit_code == 2 and "nope-sgs" in done.output
