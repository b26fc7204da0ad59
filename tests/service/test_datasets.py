"""`spiked datasets`: what it lists, checks, and runs."""

import csv
import json
import os
import signal
import subprocess
import sys
import time
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from click.testing import Result
from spiked_service.cli.main import app
from typer.testing import CliRunner

from spiked.datasets import KINDS
from spiked.errors import SpikedError
from spiked.pose import Array
from spiked.recording import RecordingWriter, open_recording
from spiked.render import Camera, rasteriser_for
from spiked.scene import Scene
from spiked.sensor import Image, Intrinsics, Sensor
from spiked.simulate import MotionKind, SimulatedCamera
from spiked.trajectory import Trajectory

from ..datasets.layouts import Source, save_picture, write_colmap

SENSOR = Sensor(400, 250, 20_000.0, intrinsics=Intrinsics.from_fov(400, 250, 60))
FRAMES = 192
OPTIONS = ("--steps", "0", "--fov", "60")


def spiked(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, ["datasets", *map(str, arguments)])


@pytest.fixture(scope="module")
def streams(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of recVidarReal2019: an arc through the room with its poses, and a stream too short for a path."""
    folder = tmp_path_factory.mktemp("streams")
    (folder / "classB").mkdir()
    camera = SimulatedCamera(SENSOR, 3, MotionKind.ARC, flow_px=0.3, step_px=0.8)
    frames = camera.next_frames(FRAMES)
    (folder / "classB" / "train.dat").write_bytes(frames.tobytes())
    (folder / "classB" / "wheel.dat").write_bytes(frames[:20].tobytes())
    times = (np.arange(FRAMES) + 0.5) / SENSOR.frame_rate_hz
    Trajectory(times, *camera.truth(np.arange(FRAMES))).write_tum(folder / "classB" / "train.tum")
    return folder


def test_all_kinds_are_listed_with_how_to_get_them() -> None:
    done = spiked()
    assert done.exit_code == 0, done.output
    text = " ".join(done.output.split())
    for kind in KINDS:
        assert f"spiked datasets run {kind.name} FOLDER -o OUT" in text
    assert "CC BY 4.0" in text


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_what_is_known_of_a_kind_is_printed(kind: object) -> None:
    name = kind.name  # type: ignore[attr-defined]
    done = spiked("show", name)
    assert done.exit_code == 0, done.output
    assert all(word in done.output for word in ("sensor", "licence", "published", "layout", "known", "cite"))


def test_no_registry_of_packages_is_named() -> None:
    assert not any(host in repr(KINDS) for host in ("pypi", "npmjs", "files.pythonhosted"))


def test_a_check_records_and_then_compares(streams: Path, tmp_path: Path) -> None:
    folder = tmp_path / "set"
    (folder / "classA").mkdir(parents=True)
    (folder / "classA" / "a.dat").write_bytes(bytes(3 * 12_500))
    first, second = spiked("check", folder), spiked("check", folder)
    assert (first.exit_code, second.exit_code) == (0, 0), first.output + second.output
    assert "classA/a: 3 frames of 400x250, 20000 Hz, grey" in first.output
    assert "checksums recorded in" in first.output and "checksums as on" in second.output
    (folder / "classA" / "a.dat").write_bytes(b"\1" + bytes(3 * 12_500 - 1))
    changed = spiked("check", folder)
    assert isinstance(changed.exception, SpikedError) and "a.dat has changed since" in str(changed.exception)


def test_a_run_scores_writes_a_table_and_keeps_what_is_finished(streams: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    command = ("run", "recvidarreal", streams, "-o", out, *OPTIONS)
    done = spiked(*command)
    assert done.exit_code == 1, f"{done.output} {done.exception}"  # wheel is too short
    with (out / "table.csv").open() as file:
        rows = {row["recording"]: row for row in csv.DictReader(file)}
    assert rows["classB/train"]["outcome"] == "complete"
    assert float(rows["classB/train"]["ate_percent"]) < 10 and float(rows["classB/train"]["coverage"]) > 0.9
    assert "too short" in rows["classB/wheel"]["outcome"]
    with zipfile.ZipFile(out / "recvidarreal.zip") as archive:
        names = set(archive.namelist())
        versions = json.loads(archive.read("versions.json"))
        trajectory = archive.read("classB__train/trajectory.tum")
    expected = {"table.md", "classB__train/overview.png", "classB__train/report.json", "classB__train/score.json"}
    assert expected <= names and not any(name.endswith((".dat", ".ply")) for name in names)
    assert "spiked" in versions
    assert trajectory == (out / "results" / "classB__train" / "trajectory.tum").read_bytes()
    before = (out / "results" / "classB__train" / "report.json").stat().st_mtime_ns
    again = spiked(*command)
    assert again.output.count("finished before") == 2
    assert (out / "results" / "classB__train" / "report.json").stat().st_mtime_ns == before
    retried = spiked(*command, "--retry")
    assert retried.output.count("finished before") == 1 and "classB/wheel: finished" not in retried.output
    os.utime(streams / "classB" / "train.dat")
    changed = spiked(*command)
    assert "classB/wheel: finished before" in changed.output and "classB/train: finished" not in changed.output
    other = spiked("run", "recvidarreal", streams, "-o", out, "--steps", "1")
    assert isinstance(other.exception, SpikedError) and "give the same ones to go on" in str(other.exception)


def test_options_that_cannot_be_used_end_the_run(streams: Path, tmp_path: Path) -> None:
    done = spiked("run", "recvidarreal", streams, "-o", tmp_path / "out", "--stepz", "0")
    assert done.exit_code == 2 and "--stepz" in done.output
    assert not (tmp_path / "out").exists()
    done = spiked("run", "recvidarreal", streams, "-o", tmp_path / "out2", "--only", "classB/none")
    assert isinstance(done.exception, SpikedError) and "classB/train" in str(done.exception)


@pytest.mark.slow
def test_a_run_that_is_interrupted_goes_on(streams: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    command = [sys.executable, "-m", "spiked_service", "datasets", "run", "recvidarreal", str(streams)]
    command += ["-o", str(out), "--only", "classB/train", "--fov", "60", "--steps", "20000"]
    log = out / "results" / "classB__train.log"
    for until in ("refining", "resumed: "):
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        deadline = time.monotonic() + 120
        while not (log.exists() and until in log.read_text()) and time.monotonic() < deadline:
            time.sleep(0.1)
        process.send_signal(signal.SIGTERM)
        _, said = process.communicate(timeout=60)
        assert process.returncode == 130, said
        assert "the same command goes on" in said
        assert (out / "results" / "classB__train" / "checkpoint").is_dir()
    assert until in log.read_text()
    assert not (out / "table.md").exists()


def test_recordings_that_were_made_are_removed_at_the_end(streams: Path, tmp_path: Path) -> None:
    folder = tmp_path / "set"
    (folder / "train").mkdir(parents=True)
    np.savez_compressed(folder / "train" / "a.npz", spk=np.zeros((30, 16, 24), bool))
    done = spiked("run", "spike-zoo", folder, "-o", tmp_path / "out", *OPTIONS)
    assert done.exit_code == 1, f"{done.output} {done.exception}"
    assert list((tmp_path / "out" / "recordings").iterdir()) == []
    assert "a.npz" in json.loads((folder / "spiked-dataset.lock.json").read_text())["files"].__repr__()


def test_a_stream_of_a_recording_of_our_own_is_left_as_it_is(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "own.dat", SENSOR) as writer:
        writer.append(np.zeros((20, SENSOR.frame_bytes), np.uint8))
    before = (tmp_path / "own.json").read_bytes()
    done = spiked("run", "outdoor-spike", tmp_path, "-o", tmp_path / "out", *OPTIONS)
    assert done.exit_code == 1, f"{done.output} {done.exception}"
    assert (tmp_path / "own.json").read_bytes() == before


Views = tuple[Trajectory, Intrinsics, Callable[[Array, Array], Image]]
"""Poses, optics, and what draws a picture with values in [0, 1] from a pose."""


def views_of_the_room() -> Views:
    """96 views along an arc through the built-in room."""
    camera = SimulatedCamera(SENSOR, 3, MotionKind.ARC, flow_px=0.3, step_px=0.8)
    frames = np.arange(0, 384, 4)
    path = Trajectory(frames / 1.0, *camera.truth(frames))
    return path, camera.intrinsics, lambda r, c: camera.view(r, c, undistorted=True) / camera.gain


def views_of_living(shared: Path) -> Views:
    """96 views of `living`, at the poses of every eighth frame."""
    sensor = open_recording(shared / "streams" / "living" / "living.dat").sensor
    truth = Trajectory.read_tum(shared / "streams" / "living" / "groundtruth.tum")
    frames = np.arange(0, 768, 8)
    assert sensor.intrinsics is not None
    rasteriser = rasteriser_for(Camera(sensor.intrinsics, sensor.width, sensor.height))
    scene = Scene.read_ply(shared / "scenes" / "living.ply")
    path = Trajectory(frames / 1.0, truth.rotations[frames], truth.centres[frames])
    return path, sensor.intrinsics, lambda r, c: rasteriser.forward(scene, r[None], c[None]).values


@pytest.mark.slow
@pytest.mark.parametrize("views", ["room", "living"])
def test_spikes_made_of_a_scene_of_pictures_are_reconstructed(
    views: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    scene = tmp_path / "tanks" / "room"
    path, intrinsics, draw = (
        views_of_the_room() if views == "room" else views_of_living(request.getfixturevalue("shared"))
    )
    names = [f"{number}.png" for number in range(len(path))]
    for name, rotation, centre in zip(names, path.rotations, path.centres, strict=True):
        picture = np.round(255 * np.clip(draw(rotation, centre), 0, 1)).astype(np.uint8)
        save_picture(scene / "images" / name, picture)
    source = Source(np.zeros((1, SENSOR.height, SENSOR.width), np.uint8), intrinsics, path)
    write_colmap(scene / "sparse" / "0", names, path.matrices(), source)
    given = ("--simulate", "--picture-rate 5000 --gamma linear")
    out = tmp_path / "out"
    (out / "recordings" / "room.part.pictures").mkdir(parents=True)  # of a run that was killed
    done = spiked("run", "tanks-and-temples", tmp_path / "tanks", "-o", out, *given, "--steps", "200")
    assert done.exit_code == 0, f"{done.output} {done.exception}"
    with (out / "table.csv").open() as file:
        (row,) = csv.DictReader(file)
    assert float(row["ate_percent"]) < 5 and float(row["psnr_db"]) > 20
