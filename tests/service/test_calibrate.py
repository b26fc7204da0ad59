"""`spiked calibrate`, and reconstructions with a calibration or a mosaic found by the pixels."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from spiked.recording import RecordingWriter
from spiked.sensor import Intrinsics, Mosaic, Sensor
from spiked.simulate import MotionKind, SensorNoise, SimulatedCamera
from spiked.simulate.sensor import SpikeSensor
from tests.still_recordings import pixels, place, still

SENSOR = Sensor(160, 96, 20000.0, intrinsics=Intrinsics.from_fov(160, 96, 60))


def spiked(*arguments: object) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, "-m", "spiked_service", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def record(path: Path, sensor: Sensor, frames: "np.ndarray") -> Path:
    with RecordingWriter(path, sensor) as writer:
        writer.append(frames)
    return path


@pytest.fixture(scope="module")
def calibration(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of the sensor that the recordings below are made with."""
    folder = tmp_path_factory.mktemp("calibration")
    sensor = SpikeSensor(SENSOR, 2, SensorNoise(dead_share=0.005))
    for name, light in (("flat", 0.2), ("dark", 0.0)):
        image = np.full((96, 160), light, np.float32)
        record(folder / f"{name}.dat", SENSOR, sensor.expose(image, image, np.zeros(3000, np.float32)))
    done = spiked("calibrate", folder / "flat.dat", "--dark", folder / "dark.dat", "-o", folder / "camera.npz")
    assert done.returncode == 0, done.stderr
    dead = int((sensor.gain == 0).sum())
    assert f"{dead} of 15360 pixels dead or hot" in done.stdout
    return folder / "camera.npz"


def test_a_reconstruction_uses_a_calibration(calibration: Path, tmp_path: Path) -> None:
    camera = SimulatedCamera(SENSOR, 2, MotionKind.ARC, noise=SensorNoise(dead_share=0.005), flow_px=0.25, parallax=0.5)
    recording = record(tmp_path / "arc.dat", SENSOR, camera.next_frames(480))
    done = spiked("reconstruct", recording, "-o", tmp_path / "out", "--steps", 60, "--calibration", calibration)
    assert done.returncode == 0, done.stderr
    assert json.loads((tmp_path / "out" / "report.json").read_text())["options"]["calibration"] is True


def test_a_calibration_of_another_camera_is_refused(calibration: Path, tmp_path: Path) -> None:
    other = Sensor(64, 48, 20000.0, intrinsics=Intrinsics.from_fov(64, 48, 60))
    recording = record(tmp_path / "other.dat", other, SimulatedCamera(other, 1).next_frames(64))
    done = spiked("reconstruct", recording, "-o", tmp_path / "out", "--calibration", calibration)
    assert done.returncode == 2 and "160x96" in done.stderr and "64x48" in done.stderr


def test_a_wrong_mosaic_is_said_and_corrected_on_request(tmp_path: Path) -> None:
    true = Sensor(160, 96, 20000.0, mosaic=Mosaic.GRBG, intrinsics=SENSOR.intrinsics)
    said = Sensor(160, 96, 20000.0, mosaic=Mosaic.BGGR, intrinsics=SENSOR.intrinsics)
    camera = SimulatedCamera(true, 2, MotionKind.ARC, flow_px=0.25, parallax=0.5)
    recorded_frames = camera.next_frames(480)
    recording = record(tmp_path / "rec.dat", said, recorded_frames)
    done = spiked("reconstruct", recording, "-o", tmp_path / "wrong", "--steps", 20)
    assert "--mosaic auto" in done.stderr and "GRBG" in done.stderr
    report = json.loads((tmp_path / "wrong" / "report.json").read_text())
    assert any("mosaic" in warning for warning in report["warnings"])
    done = spiked("reconstruct", recording, "-o", tmp_path / "right", "--steps", 20, "--mosaic", "auto")
    question = "by its pixels the mosaic is GRBG or GBRG, and they cannot say which (stated: BGGR): GRBG is taken"
    assert question in " ".join(done.stderr.split())
    (asked,) = json.loads((tmp_path / "right" / "report.json").read_text())["warnings"]
    assert asked.startswith(question)
    agreed = record(tmp_path / "agreed.dat", true, recorded_frames)
    done = spiked("reconstruct", agreed, "-o", tmp_path / "agreed", "--steps", 20, "--mosaic", "auto")
    assert "the pixels agree with the stated mosaic: GRBG" in done.stderr
    assert json.loads((tmp_path / "agreed" / "report.json").read_text())["warnings"] == []


def test_a_person_is_led_through_a_calibration(tmp_path: Path) -> None:
    covered, wall = still(tmp_path / "dark.dat", SENSOR, 0), still(tmp_path / "wall.dat", SENSOR, 0.2)
    scene = SimulatedCamera(SENSOR, 2, MotionKind.ARC)
    lit = record(tmp_path / "scene.dat", SENSOR, scene.next_frames(600))
    camera = tmp_path / "camera.dat"
    place(camera, lit)
    command = [sys.executable, "-m", "spiked_service", "calibrate", "--device", f"replay:{camera}", "--seconds", "0.02"]
    command += ["-o", str(tmp_path / "c.npz"), "--write-profile", str(tmp_path / "profile.json")]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(command, text=True, **pipes) as wizard:
        assert wizard.stdin is not None and wizard.stdout is not None and wizard.stderr is not None

        def answer(text: str, until: str) -> None:
            """Write a line, and read until the wizard has said something."""
            wizard.stdin.write(f"{text}\n")
            wizard.stdin.flush()
            said = ""
            while until not in said:
                line = wizard.stderr.readline()
                assert line, f"{until!r} was not said, but {said}"
                said += line

        assert "Cover the lens" in wizard.stderr.readline()
        answer("", "is not dark")  # the lens was not covered
        assert "Cover the lens" in wizard.stderr.readline()
        place(camera, covered)
        answer("", "Uncover it")
        place(camera, wall)
        out, told = wizard.communicate("\n")
    assert wizard.returncode == 0, told
    truth = pixels(SENSOR)
    useless = int(((truth.gain == 0) | (truth.dark > 0.1)).sum())
    assert f"{useless} of 15360 pixels dead or hot" in out
    assert json.loads((tmp_path / "profile.json").read_text())["calibration"] == "c.npz"
    assert [file.name for file in tmp_path.iterdir() if file.name.startswith(".")] == []


def test_a_dark_recording_completes_a_calibration(tmp_path: Path) -> None:
    wall, covered = still(tmp_path / "wall.dat", SENSOR, 0.2), still(tmp_path / "dark.dat", SENSOR, 0)
    out = tmp_path / "c.npz"
    assert spiked("calibrate", wall, "-o", out).returncode == 0
    with np.load(out) as first:
        gain, dead = first["gain"], first["dead"]
    done = spiked("calibrate", "--dark", covered, "-o", out)
    assert done.returncode == 0, done.stderr
    with np.load(out) as second:
        np.testing.assert_array_equal(second["gain"], gain)
        assert second["dead"].sum() > dead.sum() and float(np.median(second["dark"])) > 0.001


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ((), "with one in the dark, or --device"),
        (("--board", "9x6"), "--board needs a recording"),
        (("--device", "sim:", "--dark", "x.dat"), "leave out recordings"),
        (("--device", "sim:", "--rate", "20000"), "with the device"),
        (("--device", "sim:"), "nobody answers"),
        (("--device", "nothing:"), "nothing:"),
    ],
)
def test_a_calibration_of_nothing_is_refused(tmp_path: Path, arguments: tuple[str, ...], told: str) -> None:
    command = [sys.executable, "-m", "spiked_service", "calibrate", "-o", str(tmp_path / "c.npz"), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL)
    assert done.returncode == 2 and told in done.stderr and "Traceback" not in done.stderr
    assert list(tmp_path.iterdir()) == []
