"""`spiked offset` and the measured rate of `spiked info`."""

import json
from pathlib import Path

import numpy as np
import pytest
from spiked_service.cli.main import app
from typer.testing import CliRunner

from spiked.recording import RecordingWriter
from spiked.sensor import Sensor

START_NS = 1_800_000_000_000_000_000


def recorded(path: Path, start_s: float, pairs: int) -> Path:
    """1,000 frames at 999.99 Hz, the first at `start_s`."""
    sensor = Sensor(16, 8, 1000.0)
    with RecordingWriter(path, sensor) as writer:
        writer.append(np.zeros((1000, sensor.frame_bytes), np.uint8))
        for frame in range(0, 100 * pairs, 100):
            writer.clock_pair(frame, START_NS + round(1e9 * (start_s + frame / 999.99)))
    return path


def run(*arguments: object, code: int = 0) -> str:
    done = CliRunner().invoke(app, [str(one) for one in arguments])
    assert done.exit_code == code, done.output
    return done.output


def test_the_offset_of_two_recordings_is_printed(tmp_path: Path) -> None:
    left, right = recorded(tmp_path / "left.dat", 0.0, 9), recorded(tmp_path / "right.dat", 0.25, 9)
    text = run("offset", left, right, "--frame", 500)
    assert "right.dat begins 250.000 ms after left.dat (standard deviation 0.071 ms)" in text
    assert "frame 500 of left.dat came with frame 250.00 of right.dat" in text
    assert "250.000 ms before right.dat" in run("offset", right, left)
    figures = json.loads(run("offset", left, right, "--frame", 500, "--json"))
    assert figures["offset_s"] == pytest.approx(0.25) and figures["frame_of_second"] == pytest.approx(250, abs=0.01)


def test_few_clock_pairs_leave_the_error_open(tmp_path: Path) -> None:
    left, right = recorded(tmp_path / "left.dat", 0.0, 2), recorded(tmp_path / "right.dat", 0.25, 9)
    assert "too few clock pairs for a standard deviation" in run("offset", left, right)
    assert json.loads(run("offset", left, right, "--json"))["offset_sigma_s"] is None


def test_a_recording_without_clock_pairs_has_no_offset(tmp_path: Path) -> None:
    left, right = recorded(tmp_path / "left.dat", 0.0, 9), recorded(tmp_path / "right.dat", 0.0, 0)
    done = CliRunner().invoke(app, ["offset", str(left), str(right)])
    assert done.exit_code != 0 and "no clock pairs" in str(done.exception)


def test_info_has_the_measured_rate(tmp_path: Path) -> None:
    text = run("info", recorded(tmp_path / "left.dat", 0.0, 9))
    assert "999.990 Hz by this machine's clock" in text and "-10.0 ppm from the stated rate" in text
    assert "clock" not in run("info", recorded(tmp_path / "right.dat", 0.0, 2))
