"""A simulated recording is a folder that can be scored: frames, sidecar, truth and held-out views belong together."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from spiked.errors import ConfigurationError, RecordingError, SceneError
from spiked.evaluate import psnr
from spiked.recording import open_recording
from spiked.render import Camera, Rasteriser
from spiked.scene import Scene
from spiked.sensor import Intrinsics, Layout, Mosaic, Sensor
from spiked.simulate import SensorNoise, SimulatedCamera
from spiked.simulate.motion import Recorded
from spiked.simulate.record import camera_of_files, simulate
from spiked.trajectory import Trajectory

SHARED = Path(__file__).resolve().parents[3] / "shared"
LIVING = SHARED / "streams" / "living"


@pytest.mark.parametrize("mosaic", [None, Mosaic.BGGR], ids=["grey", "colour"])
def test_the_folder_holds_what_the_camera_saw(tmp_path: Path, mosaic: Mosaic | None) -> None:
    sensor = Sensor(64, 40, 20000.0, mosaic=mosaic)
    told: list[int] = []
    path = simulate(SimulatedCamera(sensor, 1), tmp_path / "walk", "walk", 150, views=4, progress=told.append)
    assert told == [64, 128, 150]
    recording = open_recording(path)
    assert recording.frames == 150
    assert replace(recording.sensor, intrinsics=None) == sensor
    assert np.array_equal(recording.read(0, 150), SimulatedCamera(sensor, 1).next_frames(150))

    camera = SimulatedCamera(sensor, 1)
    truth = Trajectory.read_tum(path.parent / "groundtruth.tum")
    rotations, centres = camera.truth(np.arange(150))
    assert np.allclose(truth.centres, centres, atol=1e-8) and np.allclose(truth.rotations, rotations, atol=1e-7)
    table = json.loads((path.parent / "views.json").read_text())
    assert [view["on_trajectory"] for view in table["views"]] == [True, False, True, False]
    for view in table["views"]:
        pose = np.array(view["c2w"])
        picture = cv2.imread(str(path.parent / view["file"]), cv2.IMREAD_UNCHANGED)
        expected = camera.view(pose[:3, :3], pose[:3, 3]) / table["gain"]
        shown = picture[..., ::-1] if mosaic else picture
        assert np.abs(shown / 255 - np.clip(expected, 0, 1)).max() < 0.5 / 255 + 1e-6
        nearest = np.abs(centres - pose[:3, 3]).sum(1).min()
        assert (nearest < 1e-6) == view["on_trajectory"]
        assert 0.8 < view["coverage"] <= 1


def test_views_beside_the_path_show_what_its_frames_saw(tmp_path: Path) -> None:
    """The camera pans to and fro about all axes by more than a view beside the path is turned and moved."""
    sensor = Sensor(96, 60, 20000.0)
    start = SimulatedCamera(sensor, 1).motion.poses([0.0])
    angles = np.array([[0.0, 0, 0], [0.08, 0, 0], [-0.08, 0, 0], [0, 0.08, 0], [0, -0.08, 0], [0, 0, 0]])
    turn = np.array([cv2.Rodrigues(angle)[0] for angle in angles])
    motion = Recorded(np.linspace(0, 1280, 6), start[0] @ turn, np.repeat(start[1], 6, 0))
    path = simulate(SimulatedCamera(sensor, 1, motion, step_px=2.0), tmp_path / "pan", "pan", 1280, views=12)
    views = json.loads((path.parent / "views.json").read_text())["views"]
    assert all(view["coverage"] >= 0.999 for view in views)
    beside = np.array([view["c2w"] for view in views if not view["on_trajectory"]])
    assert len(beside) == 6 and np.linalg.norm(beside[:, :3, 3] - start[1], axis=1).min() > 0.01


def test_nothing_is_written_over(tmp_path: Path) -> None:
    (tmp_path / "precious").write_text("x")
    with pytest.raises(RecordingError, match="not empty"):
        simulate(SimulatedCamera(Sensor(64, 40, 20000.0)), tmp_path, "walk", 8, views=1)
    assert [file.name for file in tmp_path.iterdir()] == ["precious"]


@pytest.mark.parametrize("until", [64, 150], ids=["between frames", "before the views"])
def test_nothing_is_left_of_a_simulation_that_is_interrupted(until: int, tmp_path: Path) -> None:
    """Its first frames would pass for a recording of fewer, without truth."""

    def interrupt(done: int) -> None:
        if done == until:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate(SimulatedCamera(Sensor(64, 40, 20000.0)), tmp_path, "walk", 150, views=1, progress=interrupt)
    assert list(tmp_path.iterdir()) == []


def test_other_layouts_are_refused_before_anything_is_written(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="convert"):
        simulate(SimulatedCamera(Sensor(64, 40, 20000.0, Layout.ROW_TAGGED)), tmp_path / "walk", "walk", 8)
    assert not (tmp_path / "walk").exists()


def test_a_missing_scene_is_a_clear_error(tmp_path: Path) -> None:
    (tmp_path / "path.tum").write_text("0 0 0 0 0 0 0 1\n1 0 0 1 0 0 0 1\n")
    with pytest.raises(SceneError, match=r"none\.ply"):
        camera_of_files(Sensor(64, 40, 20000.0), tmp_path / "none.ply", tmp_path / "path.tum")


def wall(*, brightest: float) -> Scene:
    """A wall two units ahead, grey in patches from black to `brightest`."""
    rng = np.random.default_rng(3)
    y, x = np.mgrid[-1.5:1.5:60j, -2:2:80j]
    n = x.size
    return Scene(
        np.stack([x.ravel(), y.ravel(), np.full(n, 2.0)], 1).astype(np.float32),
        np.tile(np.float32([1, 0, 0, 0]), (n, 1)),
        np.tile(np.log(np.float32([0.04, 0.04, 0.01])), (n, 1)),
        np.full(n, 4, np.float32),
        np.repeat(rng.uniform(0.2, 1, (n // 16, 1)), 16, 0).astype(np.float32) * np.float32(brightest),
    )


@pytest.mark.parametrize(
    ("white", "gain", "expected"),
    [(0.12, None, 1.0), (0.12, 0.24, 2.0), (None, None, 0.35), (None, 0.2, 0.2)],
    ids=["our own", "our own, brighter", "of another program", "of another program, darker"],
)
def test_a_scene_is_recorded_at_the_radiance_at_which_it_is_rendered(
    tmp_path: Path, white: float | None, gain: float | None, expected: float
) -> None:
    scene, sensor = wall(brightest=white or 1), Sensor(96, 64, 20000.0, intrinsics=Intrinsics.from_fov(96, 64, 50))
    scene.write_ply(tmp_path / "wall.ply", white)
    (tmp_path / "path.tum").write_text("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n")
    camera = camera_of_files(sensor, tmp_path / "wall.ply", tmp_path / "path.tum", noise=SensorNoise.none(), gain=gain)
    path = simulate(camera, tmp_path / "wall", "wall", 512, views=1)
    recorded = np.unpackbits(open_recording(path).read(0, 512)).mean()
    assert sensor.intrinsics is not None
    rasteriser = Rasteriser(Camera(sensor.intrinsics, 96, 64))
    rendered = rasteriser.forward(scene, np.eye(3)[None], np.zeros((1, 3))).values.mean()
    assert recorded == pytest.approx(expected * rendered, rel=0.02)
    shown = cv2.imread(str(path.parent / "views" / "00.png"), cv2.IMREAD_GRAYSCALE) / 255
    assert shown.mean() == pytest.approx(rendered / (white or 1), rel=0.02)


@pytest.mark.skipif(not LIVING.exists(), reason="needs ../shared/streams and ../shared/scenes")
def test_the_living_room_is_reproduced_from_its_scene_and_path() -> None:
    """Same scene, path and sensor model as `streams/living`, another seed: the pictures and the rates agree."""
    sensor = Sensor(400, 250, 20000.0, intrinsics=Intrinsics(346.4101615137755, 346.4101615137755, 200.0, 125.0))
    camera = camera_of_files(sensor, SHARED / "scenes" / "living.ply", LIVING / "groundtruth.tum", threads=2)
    view = json.loads((LIVING / "views.json").read_text())["views"][0]
    pose = np.array(view["c2w"])
    picture = cv2.imread(str(LIVING / view["file"]), cv2.IMREAD_GRAYSCALE) / 255
    assert psnr(np.clip(camera.view(pose[:3, :3], pose[:3, 3]) / camera.gain, 0, 1), picture) > 42
    theirs = np.fromfile(LIVING / "living.dat", np.uint8, 32 * 12500)
    ours = camera.next_frames(32)
    rates = [np.unpackbits(x.reshape(32, 250, 50), axis=2, bitorder="little").mean(0) for x in (theirs, ours)]
    blurred = [cv2.GaussianBlur(rate, (0, 0), 2) for rate in rates]
    assert rates[1].mean() == pytest.approx(rates[0].mean(), rel=0.01)
    assert np.corrcoef(blurred[0].ravel(), blurred[1].ravel())[0, 1] > 0.995
