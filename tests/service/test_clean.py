"""`spiked clean`."""

from pathlib import Path

from spiked_service.cli.main import app
from spiked_service.results.map_folder import MapFolder
from typer.testing import CliRunner

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
