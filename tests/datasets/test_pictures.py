"""Scenes of pictures: pictures, poses, optics and times come back as they were written."""

import json
from pathlib import Path

import numpy as np
import pytest

from spiked.datasets import PictureScene, find_kind, recognise
from spiked.datasets.colmap_model import MODELS, intrinsics_of
from spiked.distortion import Distortion, LensModel
from spiked.errors import ConfigurationError, SpikedError

from .layouts import Source, numbered, save_picture, write_colmap, write_transforms


def only_scene(name: str, folder: Path) -> PictureScene:
    (scene,) = find_kind(name).open(folder).items
    assert isinstance(scene, PictureScene)
    return scene


def written(folder: Path, source: Source) -> list[str]:
    """Pictures named so that the order of letters is another one than that of numbers."""
    frames = numbered(source)
    for k, frame in enumerate(frames):
        save_picture(folder / "images" / f"frame{8 + k}.png", source.picture(frame))
    return [f"frame{8 + k}.png" for k in range(len(frames))]


def check(scene: PictureScene, source: Source, names: list[str]) -> None:
    assert [path.name for path in scene.pictures] == names
    poses = source.poses(numbered(source))
    np.testing.assert_allclose(scene.rotations, poses[:, :3, :3], atol=1e-12)
    np.testing.assert_allclose(scene.centres, poses[:, :3, 3], atol=1e-12)
    assert (scene.intrinsics, (scene.width, scene.height)) == (source.intrinsics, source.size)


@pytest.mark.parametrize("kind", ["colmap", "tanks-and-temples", "deblur-nerf"])
@pytest.mark.parametrize("text", [False, True], ids=["binary", "text"])
def test_a_colmap_scene_comes_back_exactly(source: Source, text: bool, kind: str, tmp_path: Path) -> None:
    names = written(tmp_path / "barn", source)
    place = tmp_path / "barn" / ("sparse" if text else "sparse/0")
    shuffled = [*range(1, len(names)), 0]
    poses = source.poses(numbered(source))[shuffled]
    write_colmap(place, [names[k] for k in shuffled], poses, source, text)
    assert recognise(tmp_path)[0].name == "colmap"
    scene = only_scene(kind, tmp_path)
    check(scene, source, names)
    assert scene.name == "barn"
    assert scene.median_depth == pytest.approx(1, abs=0.2)
    np.testing.assert_array_equal(scene.trajectory(24.0).times_s, np.arange(len(names)) / 24)


def test_a_scene_of_transforms_comes_back_exactly(source: Source, tmp_path: Path) -> None:
    names = written(tmp_path, source)
    poses = source.poses(numbered(source))
    write_transforms(tmp_path / "transforms.json", [f"images/{name}" for name in names], poses, source)
    assert recognise(tmp_path)[0].name == "transforms"
    check(only_scene("transforms", tmp_path), source, names)


def test_lens_and_times_of_transforms_are_read(source: Source, tmp_path: Path) -> None:
    names = written(tmp_path, source)
    poses = source.poses(numbered(source))
    path = tmp_path / "transforms.json"
    write_transforms(path, [f"images/{name}" for name in names], poses, source, k1=-0.1, p2=0.01)
    content = json.loads(path.read_text())
    for number, frame in enumerate(content["frames"]):
        frame["time"] = 1.0 - 0.1 * number
    path.write_text(json.dumps(content))
    scene = only_scene("transforms", tmp_path)
    assert [picture.name for picture in scene.pictures] == names[::-1]
    assert scene.times_s is not None and (np.diff(scene.times_s) > 0).all()
    assert scene.intrinsics.distortion == Distortion(LensModel.OPENCV, (-0.1, 0, 0, 0.01, 0))


def test_pictures_at_another_scale_scale_the_camera(source: Source, tmp_path: Path) -> None:
    names = written(tmp_path, source)
    for name in names:
        save_picture(tmp_path / "images" / name, source.picture(0)[::2, ::2].copy())
    write_colmap(tmp_path / "sparse" / "0", names, source.poses(numbered(source)), source)
    scene = only_scene("colmap", tmp_path)
    assert (scene.width, scene.height) == (200, 125)
    assert scene.intrinsics == source.intrinsics.scaled(0.5)


@pytest.mark.parametrize("model", [name for name, _ in MODELS.values()])
def test_camera_models_of_colmap_are_known_or_refused(model: str) -> None:
    count = dict(MODELS.values())[model]
    parameters = [100.0, 110.0, 60.0, 50.0, *[0.01] * 8]
    if model.startswith(("SIMPLE", "RADIAL")):
        parameters.pop(1)
    if model == "FULL_OPENCV":
        parameters[9:] = [0.0] * 3
    if model in ("FOV", "THIN_PRISM_FISHEYE"):
        with pytest.raises(ConfigurationError, match="undistort"):
            intrinsics_of(model, parameters[:count])
        return
    made = intrinsics_of(model, parameters[:count])
    assert (made.cx, made.cy) == (60.0, 50.0)
    assert (made.distortion is None) == model.endswith("PINHOLE")


def test_damaged_scenes_are_named(source: Source, tmp_path: Path) -> None:
    names = written(tmp_path, source)
    poses, model = source.poses(numbered(source)), tmp_path / "sparse" / "0"
    write_colmap(model, names, poses, source)
    sound = {path.name: path.read_bytes() for path in model.iterdir()}

    def fails(said: str) -> None:
        with pytest.raises(SpikedError, match=said):
            find_kind("colmap").open(tmp_path)
        for name, content in sound.items():
            (model / name).write_bytes(content)

    (model / "images.bin").write_bytes(sound["images.bin"][:-9])
    fails("cut or damaged")
    (model / "images.bin").write_bytes((2**62).to_bytes(8, "little") + sound["images.bin"][8:])
    fails("images.bin: it ends after")
    (model / "points3D.bin").write_bytes((10**9).to_bytes(8, "little"))
    fails("points3D.bin: it ends after")
    (model / "cameras.bin").write_bytes(sound["cameras.bin"].replace(b"\1\0\0\0\1\0\0\0", b"\1\0\0\0\x63\0\0\0", 1))
    fails("the model 99")
    (model / "cameras.bin").unlink()
    fails("cameras.bin: this file is missing")
    write_colmap(model, ["../../etc.png", *names[1:]], poses, source)
    fails("outside of this folder")
    (tmp_path / "images" / names[1]).unlink()
    fails("this picture is missing")
    save_picture(tmp_path / "images" / names[1], source.picture(0)[:100, :100].copy())
    fails("pictures of one size")
    (tmp_path / "images" / names[1]).write_bytes(b"no picture")
    fails("no picture that can be read")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("{", "no readable JSON"),
        ('{"frames": []}', "frames"),
        ('{"fl_x": 9, "frames": [{"file_path": "a.png", "transform_matrix": [[1]]}]}', "not 4x4"),
        ('{"frames": [{"file_path": "a.png", "transform_matrix": [[1e999]]}]}', "finite"),
        ("[" * 100_000, "no readable JSON"),
    ],
)
def test_damaged_transforms_are_named(change: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "transforms.json").write_text(change)
    with pytest.raises(SpikedError, match=said):
        find_kind("transforms").open(tmp_path)


def test_a_matrix_that_is_no_rotation_is_named(source: Source, tmp_path: Path) -> None:
    names = written(tmp_path, source)
    poses = source.poses(numbered(source)).copy()
    poses[2, :3, :3] *= 2
    write_transforms(tmp_path / "transforms.json", [f"images/{name}" for name in names], poses, source)
    with pytest.raises(SpikedError, match=f"matrix of images/{names[2]}"):
        find_kind("transforms").open(tmp_path)
