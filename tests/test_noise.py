"""The noise report: pixels whose noise is known."""

import json
from pathlib import Path

import numpy as np
import pytest
from spiked_service.cli.main import app
from typer.testing import CliRunner

from spiked.errors import RecordingError
from spiked.noise import measure_noise
from spiked.recording import RecordingWriter, open_recording
from spiked.sensor import Sensor

SENSOR = Sensor(64, 48, 20_000.0)
FRAMES = 1024


def written(path: Path, bits: np.ndarray) -> Path:
    with RecordingWriter(path, SENSOR) as writer:
        writer.append(np.packbits(bits, axis=2, bitorder="little").reshape(len(bits), -1))
    return path


@pytest.fixture
def ramps(tmp_path: Path) -> Path:
    """Pixels that gather 0.2 of a spike's charge every frame, each from a charge of its own."""
    phase = np.random.default_rng(0).uniform(size=(SENSOR.height, SENSOR.width))
    charge = phase + 0.2 * np.arange(FRAMES + 1)[:, None, None]
    return written(tmp_path / "ramps.dat", np.diff(np.floor(charge), axis=0).astype(np.uint8))


def test_ramps_have_the_clock_s_noise_only(ramps: Path) -> None:
    report = measure_noise(open_recording(ramps))
    assert report.frames == FRAMES and report.rate == pytest.approx(0.2, abs=2e-3)
    assert report.interval == pytest.approx(5, abs=0.02)
    assert [row.frames for row in report.windows] == [4, 8, 16, 32, 64]
    for row in report.windows:
        part = 0.2 * row.frames % 1
        assert row.variance == pytest.approx(part * (1 - part), abs=0.02)
        assert row.binomial_variance == pytest.approx(row.frames * 0.2 * 0.8, rel=0.02)
        assert row.charge < 0.2 * row.counted


def test_independent_spikes_are_binomial(tmp_path: Path) -> None:
    bits = (np.random.default_rng(1).uniform(size=(FRAMES, SENSOR.height, SENSOR.width)) < 0.2).astype(np.uint8)
    report = measure_noise(open_recording(written(tmp_path / "coins.dat", bits)))
    assert report.jitter == pytest.approx(np.sqrt(0.8) / 0.2, rel=0.1)  # of a geometric distribution
    for row in report.windows:
        assert row.variance == pytest.approx(row.binomial_variance, rel=0.05)


def test_the_command_prints_a_table_and_writes_json(ramps: Path, tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["noise-report", str(ramps), "--json", str(tmp_path / "noise.json")])
    assert result.exit_code == 0, result.output
    assert "variance of counts" in result.output and "5.00 +- 0.00 frames from spike to spike" in result.output
    assert len(json.loads((tmp_path / "noise.json").read_text())["windows"]) == 5


def test_what_says_nothing_about_noise_is_refused(tmp_path: Path) -> None:
    dark = np.zeros((200, SENSOR.height, SENSOR.width), np.uint8)
    with pytest.raises(RecordingError, match="no pixel has 8 spikes"):
        measure_noise(open_recording(written(tmp_path / "dark.dat", dark)))
    with pytest.raises(RecordingError, match="too few to measure noise; 80 are the least"):
        measure_noise(open_recording(written(tmp_path / "short.dat", dark[:70])))
