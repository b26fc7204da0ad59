"""Trajectory and scene files: what is written is read back, and what is no such file is refused."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from spiked.distortion import Distortion, LensModel
from spiked.errors import SceneError
from spiked.pose import exp_so3
from spiked.scene import Scene
from spiked.sensor import Intrinsics, Sensor
from spiked.trajectory import Trajectory, colmap_camera


@pytest.fixture
def path() -> Trajectory:
    rng = np.random.default_rng(0)
    return Trajectory(np.arange(5) / 20000, exp_so3(rng.normal(size=(5, 3))), rng.normal(size=(5, 3)))


@pytest.fixture
def scene() -> Scene:
    rng = np.random.default_rng(0)
    shapes = ((7, 3), (7, 4), (7, 3), (7,), (7, 1))
    return Scene(*(rng.normal(size=shape).astype(np.float32) for shape in shapes))


def test_tum_round_trip(path: Trajectory, tmp_path: Path) -> None:
    path.write_tum(tmp_path / "t.tum")
    back = Trajectory.read_tum(tmp_path / "t.tum")
    np.testing.assert_allclose(back.matrices(), path.matrices(), atol=1e-8)
    np.testing.assert_allclose(back.times_s, path.times_s, atol=1e-9)


def test_colmap_holds_world_to_camera(path: Trajectory) -> None:
    words = path.colmap().splitlines()[1].split()
    t = np.array([float(x) for x in words[5:8]])
    np.testing.assert_allclose(-path.rotations[0] @ t, path.centres[0], atol=1e-7)


def test_kitti_and_nerfstudio_hold_every_pose(path: Trajectory) -> None:
    rows = np.array([[float(x) for x in line.split()] for line in path.kitti().splitlines()])
    np.testing.assert_allclose(rows.reshape(5, 3, 4), path.matrices()[:, :3], atol=1e-8)
    sensor = Sensor(400, 250, 20000, intrinsics=Intrinsics.from_fov(400, 250, 60))
    frames = json.loads(path.nerfstudio(sensor))["frames"]
    first = np.array(frames[0]["transform_matrix"])
    np.testing.assert_allclose(first[:3, 2], -path.rotations[0][:, 2])  # OpenGL looks along -z


@pytest.mark.parametrize(
    ("lens", "colmap", "nerfstudio"),
    [
        (None, "PINHOLE 400 250 300.0 310.0 200.0 125.0", {"camera_model": "OPENCV"}),
        (
            Distortion(LensModel.OPENCV, (-0.3, 0.1, 0.01, 0.02)),
            "OPENCV 400 250 300.0 310.0 200.0 125.0 -0.3 0.1 0.01 0.02",
            {"camera_model": "OPENCV", "k1": -0.3, "k2": 0.1, "p1": 0.01, "p2": 0.02, "k3": 0.0},
        ),
        (
            Distortion(LensModel.OPENCV, (-0.3, 0.1, 0.01, 0.02, 0.05)),
            "FULL_OPENCV 400 250 300.0 310.0 200.0 125.0 -0.3 0.1 0.01 0.02 0.05 0.0 0.0 0.0",
            {"camera_model": "OPENCV", "k1": -0.3, "k2": 0.1, "p1": 0.01, "p2": 0.02, "k3": 0.05},
        ),
        (
            Distortion(LensModel.FISHEYE, (0.1, 0.02, 0.03, 0.04)),
            "OPENCV_FISHEYE 400 250 300.0 310.0 200.0 125.0 0.1 0.02 0.03 0.04",
            {"camera_model": "OPENCV_FISHEYE", "k1": 0.1, "k2": 0.02, "k3": 0.03, "k4": 0.04},
        ),
    ],
)
def test_cameras_are_exported_with_their_lens(
    path: Trajectory, lens: Distortion | None, colmap: str, nerfstudio: dict[str, object]
) -> None:
    sensor = Sensor(400, 250, 20000, intrinsics=Intrinsics(300.0, 310.0, 200.0, 125.0, lens))
    names, camera = colmap_camera(sensor).splitlines()
    assert camera == f"1 {colmap}"
    assert len(names.split()) == len(camera.split()) + 1  # and the hash
    said = json.loads(path.nerfstudio(sensor))
    assert nerfstudio.items() <= said.items() and ("k1" in said) == (lens is not None)


def test_nerfstudio_without_intrinsics_says_what_to_give(path: Trajectory) -> None:
    with pytest.raises(SceneError, match="--fov"):
        path.nerfstudio(Sensor(400, 250, 20000))


@pytest.mark.parametrize(
    "text", ["", "# nothing\n", "1 2 3\n", "0 0 0 0 0 0 0 0\n", "0 nan 0 0 0 0 0 1\n", "a b c d e f g h\n"]
)
def test_bad_tum_files_are_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "t.tum").write_text(text)
    with pytest.raises(SceneError):
        Trajectory.read_tum(tmp_path / "t.tum")


@pytest.mark.parametrize("white", [1.0, 0.3])
def test_ply_round_trip(scene: Scene, tmp_path: Path, white: float) -> None:
    scene.write_ply(tmp_path / "s.ply", white)
    back = Scene.read_ply(tmp_path / "s.ply")
    assert back.white == white
    np.testing.assert_allclose(back.colours, scene.colours, atol=1e-6)
    np.testing.assert_allclose(back.quats, scene.quats / np.linalg.norm(scene.quats, axis=1, keepdims=True), atol=1e-6)
    for a, b in zip(
        (back.means, back.log_scales, back.opacity_logits),
        (scene.means, scene.log_scales, scene.opacity_logits),
        strict=True,
    ):
        np.testing.assert_array_equal(a, b)


def test_a_ply_of_another_program_does_not_say_its_radiance(scene: Scene, tmp_path: Path) -> None:
    scene.write_ply(tmp_path / "s.ply")
    assert b"radiance" not in (tmp_path / "s.ply").read_bytes()
    back = Scene.read_ply(tmp_path / "s.ply")
    assert back.white is None and back.colour_of_white == 1
    assert back.select(np.arange(3)).join(back).white is None


def test_white_of_joined_scenes_is_the_brighter_one(scene: Scene) -> None:
    dim, bright = replace(scene, white=0.2), replace(scene, white=0.3)
    assert dim.join(bright).white == bright.join(dim).white == scene.join(bright).white == 0.3


def test_bad_scenes_are_refused(scene: Scene, tmp_path: Path) -> None:
    file = tmp_path / "s.ply"
    good = scene.ply()
    broken = {
        "not a PLY": b"hello",
        "cut short": good[:-10],
        "only binary_little_endian": good.replace(b"binary_little_endian", b"ascii"),
        "must be a positive number": scene.ply(0.3).replace(b"radiance 0.3", b"radiance nan"),
        "no property 'opacity'": good.replace(b"opacity", b"opasity"),
        "'-1' of vertex, which is no number": re.sub(rb"element vertex \d+", b"element vertex -1", good),
        "'x' of vertex, which is no number": re.sub(rb"element vertex \d+", b"element vertex x", good),
        "its first element is camera": good.replace(
            b"element vertex", b"element camera 1\nproperty float f\nelement vertex"
        ),
        "its vertices have a list": good.replace(b"property float x", b"property list uchar int n\nproperty float x"),
        "a PLY of format unknown": good.replace(b"format binary_little_endian 1.0\n", b""),
        "which is no number": re.sub(rb"element vertex \d+", b"element vertex " + b"9" * 5000, good),
        "the property x twice": good.replace(b"property float y\n", b"property float x\n"),
    }
    for message, raw in broken.items():
        file.write_bytes(raw)
        with pytest.raises(SceneError, match=message):
            Scene.read_ply(file)
