"""`spiked merge`: the folder that it writes is a map of both, and maps of two places are refused."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from click.testing import Result
from spiked_service.cli.main import app
from spiked_service.results.map_folder import MapFolder, names_of_both
from typer.testing import CliRunner

from spiked.errors import SceneError, SpikedError
from spiked.trajectory import Trajectory

from ..room_map import room_map


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, ["merge", *map(str, arguments)])


@pytest.fixture(scope="module")
def rooms(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("rooms")
    room_map(2, (0.0, 0.5)).write(folder / "left")
    room_map(2, (0.45, 0.95)).write(folder / "right")
    room_map(3, (0.0, 0.5)).write(folder / "other")
    return folder


def test_the_merged_folder_is_a_map_with_both_paths(rooms: Path, tmp_path: Path) -> None:
    done = run(rooms / "left", rooms / "right", "-o", tmp_path / "both")
    assert done.exit_code == 0, done.output
    assert "paths left, right" in done.output
    made, left = MapFolder.read(tmp_path / "both"), MapFolder.read(rooms / "left")
    assert list(made.paths) == ["left", "right"]
    assert np.allclose(made.trajectory.centres, left.trajectory.centres)
    assert np.linalg.norm(made.paths["right"].centres - room_map(2, (0.45, 0.95)).path.centres, axis=1).max() < 0.03
    assert len(made.known.trajectory) == len(made.paths["left"]) + len(made.paths["right"])
    report = json.loads((tmp_path / "both" / "report.json").read_text())
    merged = report["merged"]
    assert [one["paths"] for one in merged["maps"]] == [["left"], ["right"]]
    assert merged["similarity"]["scale"] == pytest.approx(1, rel=0.01) and 0 < merged["scale_sigma"] < 0.01
    assert report["splats"] == len(made.scene) and report["versions"]["spiked"]


def test_two_places_are_refused_and_nothing_is_written(rooms: Path, tmp_path: Path) -> None:
    done = run(rooms / "left", rooms / "other", "-o", tmp_path / "both")
    assert isinstance(done.exception, SpikedError)
    assert str(done.exception).startswith("these two do not show the same place: ")
    assert not (tmp_path / "both").exists()


def test_a_merge_that_was_killed_while_it_wrote_is_no_map(rooms: Path, tmp_path: Path) -> None:
    half = Path(shutil.copytree(rooms / "left", tmp_path / "half"))
    (half / "report.json").unlink()
    with pytest.raises(SceneError, match=r"has no report\.json"):
        MapFolder.read(half)


def test_a_report_that_names_paths_elsewhere_is_refused(rooms: Path, tmp_path: Path) -> None:
    false = Path(shutil.copytree(rooms / "left", tmp_path / "false"))
    report = json.loads((false / "report.json").read_text())
    (false / "report.json").write_text(json.dumps(report | {"paths": [{"name": "../../left/trajectory"}]}))
    with pytest.raises(SceneError, match="cannot read the camera of the map"):
        MapFolder.read(false)
    (false / "report.json").write_text(json.dumps(report | {"paths": [{"name": "gone"}]}))
    with pytest.raises(SceneError, match="cannot read trajectory"):
        MapFolder.read(false)
    Trajectory.read_tum(false / "trajectory.tum")


def test_paths_of_the_same_name_get_a_number() -> None:
    assert names_of_both(["a", "b"], ["a", "c"]) == ["a", "b", "a-2", "c"]
    assert names_of_both(["a", "a-2"], ["a"]) == ["a", "a-2", "a-3"]
    assert names_of_both(["my map"], [".."]) == ["my_map", "path"]
