"""`spiked export`: files where they were asked for, errors that say what to do."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from click.testing import Result
from spiked_service.cli.main import app
from typer.testing import CliRunner

from spiked.export import KINDS, kind
from spiked.scene import Scene

from ..room_map import room_map


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A result without its recording."""
    return room_map(3, (0.0,)).write(tmp_path_factory.mktemp("results") / "room")


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, ["export", *map(str, arguments)])


def test_a_file_lies_in_the_result_or_where_it_was_asked_for(room: Path, tmp_path: Path) -> None:
    done = run(room, "ply")
    assert done.exit_code == 0 and f"{room}/export/ply.ply: " in done.output.replace("\n", "")
    assert len(Scene.read_ply(room / "export" / "ply.ply")) == len(Scene.read_ply(room / "scene.ply"))
    assert run(room, "depth", "--views", "1", "-o", tmp_path / "maps").exit_code == 0
    assert len(list((tmp_path / "maps" / "depth").iterdir())) == 2


def test_depth_of_chosen_frames(room: Path, tmp_path: Path) -> None:
    done = run(room, "depth", "--frame", "7", "--frame", "30", "-o", tmp_path / "maps")
    assert done.exit_code == 0, done.output + str(done.exception)
    times = sorted(float(file.stem) for file in (tmp_path / "maps" / "depth").glob("*.exr"))
    assert times == pytest.approx([7.5 / 20_000, 30.5 / 20_000], abs=1e-9)


def test_metres_are_those_of_the_scale(room: Path, tmp_path: Path) -> None:
    unknown = run(room, "ply", "--metric")
    assert "spiked scale" in str(unknown.exception)
    measured = tmp_path / "measured"
    shutil.copytree(room, measured)
    command = ["scale", str(measured), "--length", "3", "1.5", "--up", "0", "0", "-1"]
    assert CliRunner().invoke(app, command).exit_code == 0
    cleaned = tmp_path / "cleaned"
    command = ["clean", str(measured), "-o", str(cleaned), "--no-floaters"]
    assert CliRunner().invoke(app, command).exit_code == 0
    assert run(cleaned, "ply", "--metric").exit_code == 0
    units, metres = Scene.read_ply(room / "scene.ply").means, Scene.read_ply(cleaned / "export/ply-metric.ply").means
    np.testing.assert_allclose(metres[:, 0], 2 * units[:, 0], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(metres[:, 1], 2 * units[:, 2], rtol=1e-5, atol=1e-6)  # down is where +z was
    np.testing.assert_allclose(metres[:, 2], -2 * units[:, 1], rtol=1e-5, atol=1e-6)


def test_errors_name_what_is_missing(room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done = run(room, "colmap", "-o", tmp_path / "project")
    assert "--recording" in str(done.exception)
    assert "is none of depth," in " ".join(run(room, "obj").output.split()).replace("│ ", "")
    monkeypatch.setattr(kind, "import_module", lambda name: __import__("a_module_that_is_not_there"))
    assert "pip install 'spiked[export]'" in str(run(room, "mesh-glb", "-o", tmp_path / "room.glb").exception)


def test_the_help_lists_every_format() -> None:
    text = " ".join(run("--help").output.split())
    assert all(f"{one.name}: " in text for one in KINDS)
