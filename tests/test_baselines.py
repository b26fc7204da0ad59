"""Pictures made of spikes, poses between pictures, and COLMAP on a recording of the built-in room."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from spiked_service.cli.main import app
from typer.testing import CliRunner

from spiked.baselines import ImageKind, PictureOptions, interpolated, run_colmap, spike_pictures
from spiked.baselines.pictures import picture_intrinsics
from spiked.errors import ConfigurationError, SceneError
from spiked.evaluate import psnr, score_trajectory
from spiked.pose import exp_so3
from spiked.recording import Recording, open_recording
from spiked.sensor import Intrinsics, Mosaic, Sensor
from spiked.simulate import MotionKind, SimulatedCamera
from spiked.simulate.record import simulate
from spiked.trajectory import Trajectory

FRAMES = 768


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """A recording of a camera that walks round a place, with its truth."""
    sensor = Sensor(256, 160, 20_000.0, intrinsics=Intrinsics.from_fov(256, 160, 60))
    camera = SimulatedCamera(sensor, motion=MotionKind.ARC, flow_px=0.15, parallax=0.5)
    return open_recording(simulate(camera, tmp_path_factory.mktemp("room") / "room", "room", FRAMES, views=2))


@pytest.mark.parametrize(
    ("frames", "windows"), [(1280, (60, 32)), (960, (60, 16)), (280, (60, 8)), (64, (32, 4)), (10**6, (60, 32))]
)
def test_a_recording_gives_up_to_60_pictures(frames: int, windows: tuple[int, int]) -> None:
    spans = PictureOptions().windows(frames)
    assert (len(spans), spans[0][1] - spans[0][0]) == windows
    assert spans[0][0] == 0 and spans[-1][1] == frames


def test_too_short_a_recording_is_told() -> None:
    with pytest.raises(ConfigurationError, match="--window-frames"):
        PictureOptions(window_frames=32).windows(31)


@pytest.mark.parametrize("kind", ImageKind)
def test_every_kind_shows_what_the_camera_sees(room: Recording, kind: ImageKind) -> None:
    made = list(spike_pictures(room, PictureOptions(kind, 32, 3)))
    assert [picture.time for picture in made] == [16, 384, 752]
    charge = [picture.pixels / 255 for picture in spike_pictures(room, PictureOptions(ImageKind.CHARGE, 32, 3))]
    blurred = [cv2.GaussianBlur(picture.pixels / 255, (0, 0), 1) for picture in made]
    assert all(psnr(a, cv2.GaussianBlur(b, (0, 0), 1)) > 20 for a, b in zip(blurred, charge, strict=True))
    assert psnr(blurred[0], charge[2]) < 20


def test_a_mosaic_gives_half_the_size_and_the_optics_of_that(room: Recording) -> None:
    coloured = replace(room, sensor=replace(room.sensor, mosaic=Mosaic.RGGB))
    (first, *_) = spike_pictures(coloured, PictureOptions(ImageKind.TFP, 32, 3))
    assert first.pixels.shape == (80, 128)
    assert picture_intrinsics(coloured.sensor).cx == pytest.approx(64)
    with pytest.raises(ConfigurationError, match="--fov"):
        picture_intrinsics(replace(room.sensor, intrinsics=None))


def test_a_steady_turn_is_interpolated_exactly_and_wide_gaps_are_not_bridged() -> None:
    times = np.array([8.0, 24.0, 40.0, 56.0, 136.0, 152.0])
    turn, way = np.array([0.001, 0.003, -0.002]), np.array([0.1, -0.2, 0.3])
    start = exp_so3(np.array([1.0, 2.0, 0.5]))

    def at(frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return start @ exp_so3(frames[:, None] * turn), frames[:, None] * way

    path = interpolated(times, at(times), frames=160, frame_rate_hz=10.0)
    frames = 10 * path.times_s
    rotations, centres = at(frames)
    assert np.allclose(path.centres, centres) and np.allclose(path.rotations, rotations, atol=1e-9)
    assert set(frames) == {k + 0.5 for k in range(160) if k < 64 or k >= 128}
    with pytest.raises(ConfigurationError, match="too few"):
        interpolated(times[:1], at(times[:1]), frames=160, frame_rate_hz=10.0)


def test_colmap_finds_the_path_and_the_command_writes_what_evaluate_reads(
    room: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delitem(sys.modules, "pycolmap", raising=False)  # other tests read with it
    out, score = tmp_path / "out", tmp_path / "score.json"
    arguments = ["--images", "charge", "--pictures", "16", "--window-frames", "32", "--map", "none"]
    done = CliRunner().invoke(app, ["baseline", str(room.path), "-o", str(out), *arguments])
    assert done.exit_code == 0, done.output
    report = json.loads((out / "report.json").read_text())["baseline"]
    assert (report["images"], report["pictures"], report["window_frames"]) == ("charge", 16, 32)
    assert report["registered"] >= 12 and report["models"] >= 1 and report["points"] > 50
    assert (out / "colmap" / "sparse" / "0" / "images.bin").exists()
    assert len(list((out / "colmap" / "images").iterdir())) == 16
    scored = CliRunner().invoke(app, ["evaluate", str(out), "--recording", str(room.path), "--json", str(score)])
    assert scored.exit_code == 0, scored.output
    figures = json.loads(score.read_text())
    assert figures["coverage"] > 0.7 and figures["ate_percent"] < 10
    assert "psnr_db" not in figures and {"ate_unit", "rpe_r_unit_deg", "rpe_t_unit"} <= figures.keys()
    assert "pycolmap" not in sys.modules, "pycolmap has to stay in a process of its own"


def test_pictures_and_map_of_an_earlier_run_are_not_taken(room: Recording, tmp_path: Path) -> None:
    out = tmp_path / "out"
    for name in ("colmap/images/00099.png", "scene.ply", "evaluation.json", "notes.txt"):
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_bytes(b"earlier")
    arguments = ["--images", "charge", "--pictures", "12", "--window-frames", "32", "--map", "none"]
    done = CliRunner().invoke(app, ["baseline", str(room.path), "-o", str(out), *arguments])
    assert done.exit_code == 0, done.output
    assert sorted(file.name for file in (out / "colmap" / "images").iterdir()) == [f"{n:05d}.png" for n in range(12)]
    assert {file.name for file in out.iterdir()} == {"colmap", "trajectory.tum", "report.json", "notes.txt"}


def test_a_map_is_fitted_to_given_poses(room: Recording, tmp_path: Path) -> None:
    out = tmp_path / "out"
    arguments = ["--poses", "given", "--images", "tfp", "--steps", "20"]
    refused = CliRunner().invoke(app, ["baseline", str(room.path), "-o", str(out), *arguments, "--pictures-only"])
    assert isinstance(refused.exception, ConfigurationError) and "is for COLMAP" in str(refused.exception)
    done = CliRunner().invoke(app, ["baseline", str(room.path), "-o", str(out), *arguments])
    assert done.exit_code == 0, done.output
    assert (out / "scene.ply").exists()
    truth = Trajectory.read_tum(room.path.parent / "groundtruth.tum")
    score = score_trajectory(
        truth=truth, estimate=Trajectory.read_tum(out / "trajectory.tum"), frame_rate_hz=room.sensor.frame_rate_hz
    )
    assert score.coverage == 1 and score.errors is not None and score.errors.ate_percent < 0.1


def test_pictures_without_features_are_told(room: Recording, tmp_path: Path) -> None:
    assert room.sensor.intrinsics is not None
    flat = [replace(picture, pixels=np.full_like(picture.pixels, 9)) for picture in
            spike_pictures(room, PictureOptions(pictures=3))]  # fmt: skip
    with pytest.raises(SceneError, match="none of 3 pictures"):
        run_colmap(flat, room.sensor.intrinsics, tmp_path)


@pytest.mark.slow
def test_the_pictures_alone_have_poses(room: Recording, tmp_path: Path) -> None:
    out = tmp_path / "out"
    arguments = ["--images", "charge", "--pictures", "16", "--window-frames", "32", "--map", "none", "--pictures-only"]
    done = CliRunner().invoke(app, ["baseline", str(room.path), "-o", str(out), *arguments])
    assert done.exit_code == 0, done.output
    registered = json.loads((out / "report.json").read_text())["baseline"]["registered"]
    assert len(Trajectory.read_tum(out / "trajectory.tum")) == registered
