"""Colour that depends on the direction: read from PLY, kept by what moves, cuts and writes scenes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData
from spiked_service.cli.main import app
from typer.testing import CliRunner

from spiked import spz
from spiked.errors import SceneError
from spiked.export import ExportOptions, ExportSource, find_kind
from spiked.export.compressed_ply import morton_order
from spiked.frame_of_reference import FrameOfReference
from spiked.harmonics import COEFFICIENTS, harmonic_basis, rotated_harmonics
from spiked.pose import exp_so3
from spiked.scene import Scene
from spiked.trajectory import Trajectory

from .room_map import room_map
from .test_spz import random_scene

DEGREES = (1, 2, 3)
NO_PATH = Trajectory.empty()


def shiny(degree: int, count: int = 500, channels: int = 3) -> Scene:
    """A scene with coefficients of chance."""
    scene = random_scene(count)
    colours = np.ascontiguousarray(np.broadcast_to(scene.colours[:, :1], (count, 3))[:, :channels])
    rest = np.random.default_rng(1).uniform(-0.3, 0.3, (count, COEFFICIENTS[degree], channels))
    return replace(scene, colours=colours, white=0.4, harmonics=rest.astype(np.float32))


def test_the_basis_is_orthonormal_and_in_the_order_of_3dgs() -> None:
    """Its code: degree 1 is -C1 y, C1 z, -C1 x, and the middle of degree 2 grows along z."""
    directions = np.random.default_rng(0).standard_normal((200_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    basis = harmonic_basis(directions)
    assert np.abs(4 * np.pi * basis.T @ basis / len(basis) - np.eye(15)).max() < 0.05
    along_x, along_y, along_z = harmonic_basis(np.eye(3))
    assert along_x[2] < 0 and along_y[0] < 0 and along_z[1] > 0 and along_z[5] > 0


@pytest.mark.parametrize("degree", DEGREES)
def test_a_turned_scene_looks_the_same_from_the_turned_place(degree: int) -> None:
    scene, turn = shiny(degree), exp_so3(np.array([0.4, -1.1, 0.7]))
    turned = replace(
        scene,
        means=(scene.means @ turn.T).astype(np.float32),
        harmonics=rotated_harmonics(scene.filled_harmonics(COEFFICIENTS[degree]), turn),
    )
    place = np.array([3.0, -2.0, 1.0])
    assert np.abs(turned.seen_from(turn @ place).colours - scene.seen_from(place).colours).max() < 1e-5
    assert np.abs(scene.seen_from(place).colours - scene.colours).max() > 0.1


@pytest.mark.parametrize("degree", DEGREES)
@pytest.mark.parametrize("channels", [1, 3])
def test_ply_keeps_them_bit_by_bit_in_the_fields_of_3dgs(tmp_path: Path, degree: int, channels: int) -> None:
    scene = shiny(degree, channels=channels)
    scene.write_ply(tmp_path / "scene.ply")
    table = PlyData.read(str(tmp_path / "scene.ply"))["vertex"].data
    assert sum(name.startswith("f_rest_") for name in table.dtype.names) == 3 * COEFFICIENTS[degree]
    rest = scene.filled_harmonics(COEFFICIENTS[degree])
    last = 3 * COEFFICIENTS[degree] - 1  # red's coefficients, then green's, then blue's
    np.testing.assert_allclose(table[f"f_rest_{last}"], rest[:, -1, -1] / 0.4, rtol=1e-6)
    again = Scene.read_ply(tmp_path / "scene.ply")
    assert again.degree == degree and again.harmonics is not None
    # equal channels become one, unless only the coefficients of chance differ
    np.testing.assert_allclose(again.harmonics, rest[..., : again.colours.shape[1]], rtol=1e-5, atol=1e-7)


def test_a_wrong_number_of_fields_is_named(tmp_path: Path) -> None:
    shiny(1).write_ply(tmp_path / "scene.ply")
    raw = (tmp_path / "scene.ply").read_bytes().replace(b"f_rest_8", b"g_rest_8")
    (tmp_path / "scene.ply").write_bytes(raw)
    with pytest.raises(SceneError, match="8 fields f_rest"):
        Scene.read_ply(tmp_path / "scene.ply")


@pytest.mark.parametrize("degree", DEGREES)
def test_spz_and_compressed_ply_keep_them_to_a_step(tmp_path: Path, degree: int) -> None:
    scene = shiny(degree)
    rest = scene.filled_harmonics(COEFFICIENTS[degree])
    back = spz.decode(spz.encode(scene, 0.4), 0.4)
    assert back.harmonics is not None and np.abs(back.harmonics - rest).max() <= 0.51 * 0.4 / 128
    find_kind("compressed-ply").write(ExportSource(NO_PATH, None, scene), tmp_path / "c.ply", ExportOptions())
    table = PlyData.read(str(tmp_path / "c.ply"))["sh"].data
    found = np.stack([table[name] for name in table.dtype.names], 1).reshape(len(scene), 3, -1).swapaxes(1, 2)
    decoded = (found / 255 * 8 - 4) * 0.4
    assert np.abs(decoded - rest[morton_order(scene.means)]).max() < 1.01 * 8 / 255 * 0.4


def test_cutting_joining_and_measuring_keep_them() -> None:
    scene = shiny(2)
    some = scene.select(np.arange(10))
    assert some.harmonics is not None and some.harmonics.shape == (10, 8, 3)
    both = some.join(replace(random_scene(5), colours=np.ones((5, 3), np.float32)))
    assert both.degree == 2 and len(both.filled_harmonics(8)) == 15
    up = FrameOfReference(2.0, (0.3, -0.8, 0.2))
    metric = up.scene(scene)
    place = np.array([1.0, 5.0, -3.0])
    there = metric.seen_from(up.points(place)).colours
    assert np.abs(there - scene.seen_from(place).colours).max() < 1e-5


def test_a_file_of_splats_is_exported_and_what_is_lost_is_said(tmp_path: Path) -> None:
    shiny(3).write_ply(tmp_path / "scene.ply")
    said = {}
    for kind in ("spz", "sog", "compressed-ply", "colmap"):
        done = CliRunner().invoke(app, ["export", str(tmp_path / "scene.ply"), kind, "-o", str(tmp_path / f"x-{kind}")])
        said[kind] = done.output.replace("\n", " ") + str(done.exception or "")
    assert "degree 3" in said["spz"] and "without" not in said["spz"]
    assert "without their view-dependent colour of degree 3" in said["sog"]
    assert "recording of scene.ply" in said["colmap"]
    assert spz.decode((tmp_path / "x-spz").read_bytes()).degree == 3


def test_a_foreign_scene_of_degree_3_is_cropped_and_written_bit_by_bit(tmp_path: Path) -> None:
    """Read, cleaned to a box and exported: each coefficient of each splat that is left is the one that was read."""
    out = room_map(3, (0.0,)).write(tmp_path / "out")
    scene = shiny(3, 4000)
    scene.write_ply(out / "scene.ply")
    given = PlyData.read(str(out / "scene.ply"))["vertex"].data
    box = ("-2", "-9", "-9", "9", "9", "2")
    for command in (
        ["clean", str(out), "-o", str(tmp_path / "cropped"), "--no-floaters", "--box", *box],
        ["export", str(tmp_path / "cropped"), "ply", "-o", str(tmp_path / "again.ply")],
    ):
        done = CliRunner().invoke(app, command)
        assert done.exit_code == 0, done.output + str(done.exception)
    found = PlyData.read(str(tmp_path / "again.ply"))["vertex"].data
    low, high = np.array(box[:3], float), np.array(box[3:], float)
    centres = np.stack([given[axis] for axis in "xyz"], axis=1)
    left = given[((centres >= low) & (centres <= high)).all(axis=1)]
    assert 100 < len(left) < len(given) and len(found) == len(left)
    names = [name for name in given.dtype.names if name.startswith("f_rest_")]
    assert len(names) == 45 and names == [name for name in found.dtype.names if name.startswith("f_rest_")]
    for name in ("x", "y", "z", "opacity", *names):
        np.testing.assert_allclose(found[name], left[name], rtol=1e-6, atol=1e-7, err_msg=name)
