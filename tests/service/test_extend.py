"""`spiked reconstruct --map`: what is known before the work begins, and a map that does not show the same place."""

import json
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import Result
from spiked_service.cli.main import app
from spiked_service.results.map_folder import MapFolder
from typer.testing import CliRunner

from spiked.errors import SceneError, SpikedError
from spiked.recording import RecordingWriter
from spiked.scene import Scene

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
def test_a_map_in_colour_is_extended_by_a_grey_recording(place: Path, tmp_path: Path) -> None:
    shutil.copytree(place / "map", tmp_path / "map")
    scene = Scene.read_ply(place / "map" / "scene.ply")
    tint = np.array([1.4, 1.0, 0.6], np.float32)
    replace(scene, colours=scene.colours * tint).write_ply(tmp_path / "map" / "scene.ply", 0.35)
    done = run(place / "again.dat", "--map", tmp_path / "map", "-o", tmp_path / "both", "--steps", "100")
    assert done.exit_code == 0, done.output
    colours = Scene.read_ply(tmp_path / "both" / "scene.ply").colours
    red, green, blue = np.median(colours, 0)
    assert (red / green, blue / green) == pytest.approx((1.4, 0.6), rel=0.05)


KILLED = """
import os, signal, sys
from spiked.trajectory import Trajectory
from spiked_service.cli.commands import reconstruct
from spiked_service.cli.main import main

where, number = sys.argv[1].split(":")
extend = reconstruct.extend

def kill(*_):
    os.kill(os.getpid(), int(number))

def killed(known, reconstructor, progress, cancelled):
    return extend(known, reconstructor, lambda share: kill() if share > 0.5 else None, cancelled)

if where == "extending":
    reconstruct.extend = killed
else:
    Trajectory.write_tum = kill
sys.argv[:2] = ["spiked"]
main()
"""
"""The program, sent a signal in the middle of the extension or while the results are written."""


def interrupted(where: str, number: int, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", KILLED, f"{where}:{number}", "reconstruct", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def contents(folder: Path) -> dict[str, bytes]:
    names = ("scene.ply", "trajectory.tum", "paths/map.tum", "paths/both.tum")
    return {name: (folder / name).read_bytes() for name in names}


@pytest.mark.slow
def test_an_extension_that_was_killed_goes_on_and_ends_with_the_same_map(place: Path, tmp_path: Path) -> None:
    arguments = [place / "again.dat", "--map", place / "map", "--steps", "60"]
    done = run(*arguments, "-o", tmp_path / "whole" / "both")
    assert done.exit_code == 0, done.output
    out = tmp_path / "both"
    for where in ("extending", "writing"):
        done = interrupted(where, signal.SIGKILL, *arguments, "-o", out)
        assert done.returncode == -signal.SIGKILL, done.stderr
        with pytest.raises(SceneError, match=r"has no report\.json"):
            MapFolder.read(out)
        done = run("--resume", out)
        assert done.exit_code == 0, done.output
        assert "resumed: done, 1200 frames" in done.stderr, "neither tracking nor refinement is repeated"
        assert contents(out) == contents(tmp_path / "whole" / "both")
        assert not (out / "checkpoint").exists()
        shutil.rmtree(out)


@pytest.mark.slow
def test_an_extension_that_is_interrupted_leaves_the_reconstruction_alone(place: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(place / "map", tmp_path / "passing"))
    out = tmp_path / "both"
    done = interrupted("extending", signal.SIGINT, place / "again.dat", "--map", folder, "-o", out, "--steps", "60")
    assert done.returncode == 130, done.stderr
    assert list(MapFolder.read(out).paths) == ["both"]
    folder.rename(tmp_path / "elsewhere")
    command = [sys.executable, "-m", "spiked_service", "reconstruct", "--resume", str(out)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2 and "is not a folder" in done.stderr
    (tmp_path / "elsewhere").rename(folder)
    done = run("--resume", out)
    assert done.exit_code == 0, done.output
    assert list(MapFolder.read(out).paths) == ["passing", "both"]


@pytest.mark.slow
def test_a_map_of_another_room_is_not_extended(place: Path, tmp_path: Path) -> None:
    done = run(place / "again.dat", "--map", place / "other", "-o", tmp_path / "alone", "--steps", "60")
    assert done.exit_code == 1, done.output
    report = json.loads((tmp_path / "alone" / "report.json").read_text())
    assert not report["extended"]["joined"]
    assert report["extended"]["reason"].startswith("these two do not show the same place")
    assert list(MapFolder.read(tmp_path / "alone").paths) == ["alone"]
