"""`spiked localise`: output, files, exit codes, and errors in one sentence."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import Result
from spiked_service.cli.main import app
from typer.testing import CliRunner

from spiked.errors import SpikedError
from spiked.recording import RecordingWriter
from spiked.sensor import Sensor
from spiked.trajectory import Trajectory

from ..room_map import SENSOR, room_map, visitor

FRAMES = 300


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a map and a recording of the same room."""
    folder = tmp_path_factory.mktemp("place")
    room_map(2).write(folder / "map")
    with RecordingWriter(folder / "again.dat", SENSOR) as writer:
        writer.append(visitor(2).next_frames(FRAMES))
    return folder


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, ["localise", *map(str, arguments)])


def said(*arguments: str | Path) -> str:
    """The error of a run that cannot be done."""
    done = run(*arguments)
    assert isinstance(done.exception, SpikedError), done.output
    return str(done.exception)


def test_poses_and_figures_are_written(place: Path, tmp_path: Path) -> None:
    done = run(place / "map", place / "again.dat", "-o", tmp_path / "where", "--json", tmp_path / "figures.json")
    assert done.exit_code == 0, done.output
    assert done.output.startswith("recognised: ") and "last pose, at 0.0" in done.output
    path = Trajectory.read_tum(tmp_path / "where" / "trajectory.tum")
    figures = json.loads((tmp_path / "figures.json").read_text())
    assert figures["recognised"] and len(figures["views"]) == len(path) > 5
    _, centres = visitor(2).truth(path.times_s * SENSOR.frame_rate_hz - 0.5)
    assert np.linalg.norm(path.centres - centres, axis=1).max() < 0.03
    assert np.allclose([view["position"] for view in figures["views"]], path.centres, atol=1e-6)


def test_the_path_of_a_map_is_not_replaced(place: Path) -> None:
    before = (place / "map" / "trajectory.tum").read_bytes()
    assert "holds a reconstruction, whose path would be lost" in said(
        place / "map", place / "again.dat", "-o", place / "map"
    )
    assert (place / "map" / "trajectory.tum").read_bytes() == before


def test_figures_do_not_replace_the_sidecar_of_a_recording(place: Path) -> None:
    before = (place / "again.json").read_bytes()
    assert "again.json is part of a recording" in said(
        place / "map", place / "again.dat", "--json", place / "again.json"
    )
    assert (place / "again.json").read_bytes() == before


def test_a_part_of_a_recording_keeps_its_times(place: Path, tmp_path: Path) -> None:
    done = run(place / "map", place / "again.dat", "-o", tmp_path, "--start", "100", "--frames", "150")
    assert done.exit_code == 0, done.output
    times = Trajectory.read_tum(tmp_path / "trajectory.tum").times_s * SENSOR.frame_rate_hz
    assert 100 < times[0] < times[-1] < 250


def test_another_room_is_not_recognised(place: Path, tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "other.dat", SENSOR) as writer:
        writer.append(visitor(3).next_frames(FRAMES))
    done = run(place / "map", tmp_path / "other.dat", "-o", tmp_path / "where")
    assert done.exit_code == 1
    assert done.output.startswith("not recognised: ")
    assert not (tmp_path / "where").exists()


def test_a_folder_that_is_no_map_is_named(place: Path, tmp_path: Path) -> None:
    recording = place / "again.dat"
    assert "is not a folder" in said(place / "nothing", recording)
    assert "has no report.json" in said(tmp_path, recording)
    broken = Path(shutil.copytree(place / "map", tmp_path / "broken"))
    (broken / "scene.ply").unlink()
    assert "has no scene.ply" in said(broken, recording)
    (broken / "scene.ply").touch()
    assert "is not a PLY file" in said(broken, recording)
    (broken / "report.json").write_text(
        '{"outcome": "failed", "sensor": {"width": 8, "height": 8}, "focal_px": [1, 1]}'
    )
    assert "a reconstruction that has failed" in said(broken, recording)
    (broken / "report.json").write_text("{}")
    assert "cannot read the camera of the map" in said(broken, recording)


def test_recordings_that_cannot_be_recognised_are_refused(place: Path, tmp_path: Path) -> None:
    assert "beyond the 300 frames" in said(place / "map", place / "again.dat", "--start", "300")
    assert "beyond the 300 frames" in said(place / "map", place / "again.dat", "--frames", "301")
    assert "too short" in said(place / "map", place / "again.dat", "--frames", "20")
    with RecordingWriter(tmp_path / "dark.dat", SENSOR) as writer:
        writer.append(np.zeros((FRAMES, SENSOR.frame_bytes), np.uint8))
    assert "too little texture or light" in said(place / "map", tmp_path / "dark.dat")


def test_the_lens_is_the_maps_unless_the_images_differ_in_size(place: Path, tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "bare.dat", replace(SENSOR, intrinsics=None)) as writer:
        writer.append(visitor(2).next_frames(FRAMES))
    assert run(place / "map", tmp_path / "bare.dat").exit_code == 0
    wide = Sensor(320, 160, 20_000.0)
    with RecordingWriter(tmp_path / "wide.dat", wide) as writer:
        writer.append(np.zeros((FRAMES, wide.frame_bytes), np.uint8))
    assert "320x160 and the map was made with 240x160" in said(place / "map", tmp_path / "wide.dat")
