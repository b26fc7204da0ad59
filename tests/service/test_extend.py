"""`spiked reconstruct --map`: what is known before the work begins, and a map that does not show the same place."""

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import Result
from spiked_service.cli.main import app
from spiked_service.results.map_folder import MapFolder
from typer.testing import CliRunner

from spiked.errors import SpikedError
from spiked.recording import RecordingWriter

from ..room_map import SENSOR, room_map, visitor

FRAMES = 1200


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, ["reconstruct", *map(str, arguments)])


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Maps of two rooms, and a recording of one of them."""
    folder = tmp_path_factory.mktemp("place")
    room_map(2).write(folder / "map")
    room_map(3).write(folder / "other")
    with RecordingWriter(folder / "again.dat", SENSOR) as writer:
        writer.append(visitor(2, flow_px=0.1).next_frames(FRAMES))
    return folder


def test_a_map_that_cannot_be_extended_is_told_before_the_work(place: Path, tmp_path: Path) -> None:
    done = run(place / "again.dat", "--map", tmp_path, "-o", tmp_path / "out")
    assert isinstance(done.exception, SpikedError) and "has no report.json" in str(done.exception)
    done = run(place / "again.dat", "--map", place / "map", "-o", place / "map")
    assert isinstance(done.exception, SpikedError) and "is the map that is to be extended" in str(done.exception)
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_map_is_extended_by_another_recording(place: Path, tmp_path: Path) -> None:
    done = run(place / "again.dat", "--map", place / "map", "-o", tmp_path / "both", "--steps", "200")
    assert done.exit_code == 0, done.output
    made = MapFolder.read(tmp_path / "both")
    assert list(made.paths) == ["map", "both"]
    assert not (tmp_path / "both" / "checkpoint").exists()
    times = made.trajectory.times_s * SENSOR.frame_rate_hz
    _, centres = visitor(2, flow_px=0.1).truth(times - 0.5)
    assert np.linalg.norm(made.trajectory.centres - centres, axis=1).max() < 0.03, "in the map's frame and unit"
    report = json.loads((tmp_path / "both" / "report.json").read_text())["extended"]
    assert report["joined"] and min(report["psnr_db"]) > 27


@pytest.mark.slow
def test_a_map_of_another_room_is_not_extended(place: Path, tmp_path: Path) -> None:
    done = run(place / "again.dat", "--map", place / "other", "-o", tmp_path / "alone", "--steps", "60")
    assert done.exit_code == 1, done.output
    report = json.loads((tmp_path / "alone" / "report.json").read_text())
    assert not report["extended"]["joined"]
    assert report["extended"]["reason"].startswith("these two do not show the same place")
    assert list(MapFolder.read(tmp_path / "alone").paths) == ["alone"]
