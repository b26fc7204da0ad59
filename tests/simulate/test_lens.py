"""The simulated lens: pictures with distortion, against rays of single pixels."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from spiked_service.cli.main import app
from typer.testing import CliRunner

from spiked.distortion import Distortion, LensModel
from spiked.errors import RecordingError
from spiked.recording import open_recording
from spiked.recording.sidecar import read_sidecar
from spiked.scene import Scene
from spiked.sensor import Intrinsics, Sensor
from spiked.simulate import SimulatedCamera
from spiked.trajectory import Trajectory, tum_lines

WIDTH, HEIGHT = 96, 64
BARREL = Intrinsics(90.0, 90.0, 48.0, 32.0, Distortion(LensModel.OPENCV, (-0.3, 0.1, 0.003, -0.002)))
FISHEYE = Intrinsics(45.0, 45.0, 48.0, 32.0, Distortion(LensModel.FISHEYE, (0.02,)))


@pytest.mark.parametrize("intrinsics", [BARREL, FISHEYE], ids=["opencv", "fisheye"])
def test_a_pixel_sees_along_its_ray(intrinsics: Intrinsics) -> None:
    camera = SimulatedCamera(Sensor(WIDTH, HEIGHT, 20_000.0, intrinsics=intrinsics))
    rotation, centre = (poses[0] for poses in camera.truth([0]))
    seen, depth = camera.view(rotation, centre), camera.depth(rotation, centre)
    assert seen.shape == (HEIGHT, WIDTH) and np.isfinite(seen).all()
    for x, y in [(4, 5), (20, 60), (48, 32), (90, 12), (70, 50)]:
        ray = intrinsics.unproject(np.array([x + 0.5, y + 0.5]))
        # A camera without distortion, turned so that this ray is its axis, sees the pixel in the middle of its image.
        forward = ray / np.linalg.norm(ray)
        right = np.cross([0, 1, 0], forward)
        right /= np.linalg.norm(right)
        turn = rotation @ np.stack([right, np.cross(forward, right), forward], 1)
        scale = float(np.linalg.det(intrinsics.distortion.derivative(ray[:2]))) ** 0.5 * np.linalg.norm(ray) ** 1.5
        plain = Intrinsics(intrinsics.fx * scale * 8, intrinsics.fy * scale * 8, 4.0, 4.0)
        small = camera.scene.render(plain, 8, 8, turn, centre)
        assert camera.gain * small.intensity.mean() == pytest.approx(seen[y, x], abs=0.03)
        assert np.median(small.depth) / np.linalg.norm(ray) == pytest.approx(depth[y, x], rel=0.03)


def test_held_out_views_have_no_distortion(tmp_path: Path) -> None:
    options = ["--width", "96", "--height", "64", "--frames", "64", "--views", "4"]
    optics = ["--intrinsics", "90,90,48,32"]
    for folder, more in (("bent", ["--distortion=-0.3,0.1"]), ("plain", [])):
        done = CliRunner().invoke(app, ["simulate", "-o", str(tmp_path / folder), *options, *optics, *more])
        assert done.exit_code == 0, done.output
    bent, plain = (tmp_path / folder for folder in ("bent", "plain"))
    for name in ("00.png", "02.png"):  # those beside the path are drawn from what each camera saw
        assert (cv2.imread(str(bent / "views" / name)) == cv2.imread(str(plain / "views" / name))).all()
    views = json.loads((bent / "views.json").read_text())
    camera = SimulatedCamera(Sensor(96, 64, 20_000.0, intrinsics=Intrinsics(90, 90, 48, 32)))
    for view in views["views"][1::2]:
        pose = np.array(view["c2w"])
        expected = np.clip(camera.view(pose[:3, :3], pose[:3, 3]) / views["gain"], 0, 1)
        shown = cv2.imread(str(bent / view["file"]), cv2.IMREAD_UNCHANGED) / 255
        assert np.abs(shown - expected).max() < 0.5 / 255 + 1e-6
    assert (bent / "groundtruth.tum").read_bytes() == (plain / "groundtruth.tum").read_bytes()
    assert (bent / "simulated.dat").read_bytes() != (plain / "simulated.dat").read_bytes()
    assert "distortion" not in json.loads((plain / "simulated.json").read_text())["intrinsics"]
    said = json.loads((bent / "simulated.json").read_text())["intrinsics"]
    assert said["distortion"] == {"model": "opencv", "k1": -0.3, "k2": 0.1, "p1": 0, "p2": 0, "k3": 0}
    distortion = Distortion(LensModel.OPENCV, (-0.3, 0.1))
    assert open_recording(bent / "simulated.dat").sensor.intrinsics == Intrinsics(90, 90, 48, 32, distortion)
    shown = CliRunner().invoke(app, ["info", str(bent / "simulated.dat")]).output
    assert "opencv, k1 -0.3, k2 0.1" in shown
    assert not (plain / "views_lens").exists()


def test_views_through_the_lens_are_scored_in_its_own_pixels(tmp_path: Path) -> None:
    rng, count, result = np.random.default_rng(5), 300, tmp_path / "result"
    means = rng.uniform([-1.2, -0.9, 1.5], [1.2, 0.9, 3.0], (count, 3)).astype(np.float32)
    quats = np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1))
    sizes = np.full((count, 3), np.log(0.08), np.float32)
    colours = rng.uniform(0.1, 0.6, (count, 1)).astype(np.float32)
    scene = Scene(means, quats, sizes, np.full(count, 1.5, np.float32), colours)
    result.mkdir()
    scene.write_ply(result / "scene.ply")
    times = np.linspace(0, 63 / 20_000, 64)
    path = Trajectory(
        times, np.tile(np.eye(3), (64, 1, 1)), np.stack([0.1 * np.cos(1e3 * times), 40 * times, 0 * times], 1)
    )
    (result / "path.tum").write_text("".join(tum_lines([path])))
    room = tmp_path / "room"
    options = ["--width", "96", "--height", "64", "--frames", "64", "--views", "2", "--fov", "100"]
    files = ["--scene", str(result / "scene.ply"), "--poses", str(result / "path.tum"), "--distortion", "fisheye:0.02"]
    done = CliRunner().invoke(app, ["simulate", "-o", str(room), *options, *files])
    assert done.exit_code == 0, done.output
    (result / "trajectory.tum").write_bytes((room / "groundtruth.tum").read_bytes())
    recording, figures = str(room / "simulated.dat"), result / "score.json"
    done = CliRunner().invoke(app, ["evaluate", str(result), "--recording", recording, "--json", str(figures)])
    assert done.exit_code == 0, done.output
    scores = json.loads(figures.read_text())
    assert scores["lens_worst_psnr_db"] > 45 and scores["worst_psnr_db"] > 45, scores
    views = [cv2.imread(str(room / folder / "00.png")).astype(int) for folder in ("views", "views_lens")]
    assert np.abs(views[0] - views[1]).mean() > 3


def test_the_field_of_view_is_what_the_lens_shows(tmp_path: Path) -> None:
    out = tmp_path / "wide"
    options = ["--width", "96", "--height", "64", "--frames", "8", "--views", "0", "--fov", "120"]
    done = CliRunner().invoke(app, ["simulate", "-o", str(out), *options, "--distortion", "fisheye:0.02,-0.001"])
    assert done.exit_code == 0, done.output
    k = open_recording(out / "simulated.dat").sensor.intrinsics
    assert k is not None and k.distortion == Distortion(LensModel.FISHEYE, (0.02, -0.001))
    left, right = k.unproject(np.array([[0.0, 32.0], [96.0, 32.0]]))[:, 0]
    assert np.degrees(np.arctan(right) - np.arctan(left)) == pytest.approx(120)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("barrel:-0.3", "'barrel' is no model of a lens: opencv, fisheye"),
        ("-0.3,x", "is not numbers: write k1,k2,p1,p2,k3"),
        ("fisheye:1,2,3,4,5", "the fisheye model has k1, k2, k3, k4"),
    ],
)
def test_a_distortion_that_is_none_is_refused(tmp_path: Path, given: str, said: str) -> None:
    done = CliRunner().invoke(app, ["simulate", "-o", str(tmp_path / "no"), f"--distortion={given}"])
    assert done.exit_code != 0 and said in str(done.exception) + done.output


def test_a_sidecar_with_coefficients_of_another_model_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "rec.json"
    lens = {"model": "fisheye", "k1": 0.1, "p1": 0.0}
    fields = {"format": "compact", "width": 96, "height": 64, "frame_rate": 20000.0, "frames": 0, "bit_order": "lsb"}
    optics = {"fx": 90.0, "fy": 90.0, "cx": 48.0, "cy": 32.0, "distortion": lens}
    path.write_text(json.dumps(fields | {"flipped": True, "intrinsics": optics}))
    with pytest.raises(
        RecordingError,
        match=r"intrinsics\.distortion\.fisheye\.p1.*Extra inputs are not permitted; correct the sidecar",
    ):
        read_sidecar(path)
