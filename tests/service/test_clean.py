"""`spiked clean`."""

import json
from pathlib import Path

from spiked_service.cli.main import app
from spiked_service.results.map_folder import MAP_FILES, MapFolder
from typer.testing import CliRunner

from spiked.errors import ConfigurationError

from ..room_map import room_map


def test_the_cleaned_folder_is_a_map(tmp_path: Path) -> None:
    out = room_map(2, (0.0, 0.5)).write(tmp_path / "out")
    box = ["--box", "-9", "-9", "0.5", "9", "9", "9", "--no-floaters"]
    done = CliRunner().invoke(app, ["clean", str(out), "-o", str(tmp_path / "cleaned"), *box])
    assert done.exit_code == 0, done.output
    before, after = MapFolder.read(out), MapFolder.read(tmp_path / "cleaned")
    assert 0 < len(after.scene) < len(before.scene)
    assert after.scene.means[:, 2].min() >= 0.5
    assert f"{len(after.scene)} of {len(before.scene)} splats" in done.output
    report = json.loads((tmp_path / "cleaned" / "report.json").read_text())
    assert report["splats"] == len(after.scene)
    assert report["cleaned"]["outside"] == len(before.scene) - len(after.scene)


def test_nothing_of_an_earlier_result_is_left(tmp_path: Path) -> None:
    """Its score would pass for that of the cleaned scene."""
    out = room_map(2, (0.0, 0.5)).write(tmp_path / "out")
    earlier = room_map(3, (0.0,)).write(tmp_path / "cleaned")
    (earlier / "paths").mkdir()
    for name in ("evaluation.json", "scale.json", "paths/other.tum", "notes.txt"):
        (earlier / name).write_text("{}")
    assert CliRunner().invoke(app, ["clean", str(out), "-o", str(earlier)]).exit_code == 0
    assert {file.name for file in earlier.iterdir()} == {*MAP_FILES, "notes.txt"}
    itself = CliRunner().invoke(app, ["clean", str(out), "-o", str(out)])
    assert isinstance(itself.exception, ConfigurationError)


def test_a_map_that_is_not_complete_is_warned_about(tmp_path: Path) -> None:
    out = room_map(2, (0.0, 0.5)).write(tmp_path / "out")
    report = json.loads((out / "report.json").read_text())
    (out / "report.json").write_text(json.dumps({**report, "outcome": "interrupted"}))
    done = CliRunner().invoke(app, ["clean", str(out), "-o", str(tmp_path / "cleaned")])
    assert done.exit_code == 0 and "not complete: its run was interrupted" in " ".join(done.stderr.split())
    assert MapFolder.read(tmp_path / "cleaned").outcome == "interrupted"
