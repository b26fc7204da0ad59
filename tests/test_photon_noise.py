"""The noise report of single-photon cameras: pixels whose flux, dead time and crosstalk are known."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from spiked_service.cli.main import app
from typer.testing import CliRunner

from spiked.errors import RecordingError
from spiked.photon_noise import measure_photon_noise
from spiked.recording import RecordingWriter, open_recording
from spiked.sensor import Response, Sensor

SENSOR = Sensor(64, 48, 97_000.0, response=Response.BERNOULLI)
FRAMES = 1024
P = 0.3


def written(path: Path, bits: np.ndarray, sensor: Sensor = SENSOR) -> Path:
    with RecordingWriter(path, sensor) as writer:
        writer.append(np.packbits(bits, axis=2, bitorder="little").reshape(len(bits), -1))
    return path


def coins(seed: int, p: float = P) -> np.ndarray:
    shape = FRAMES, SENSOR.height, SENSOR.width
    return (np.random.default_rng(seed).uniform(size=shape) < p).astype(np.uint8)


def test_independent_photons_have_nothing_else(tmp_path: Path) -> None:
    report = measure_photon_noise(open_recording(written(tmp_path / "coins.dat", coins(1))))
    assert (report.frames, report.hot_pixels) == (FRAMES, 0)
    assert report.rate == pytest.approx(P, abs=2e-3) and report.flux == pytest.approx(-np.log(1 - P), rel=0.01)
    assert abs(report.afterpulsing) < 0.01 and abs(report.crosstalk) < 0.01
    assert [row.frames for row in report.windows] == [16, 32, 64, 128, 256]
    for row in report.windows:
        assert row.variance == pytest.approx(1, abs=0.05)
        expected = np.sqrt(P / (1 - P) / row.frames) / -np.log(1 - P)
        assert row.photon_error == pytest.approx(expected, rel=0.02)
        assert row.flux_error == pytest.approx(expected, rel=0.15)  # few windows: their spread is biased


def test_dead_time_afterpulsing_and_crosstalk_show(tmp_path: Path) -> None:
    dead = coins(2)
    for frame in range(1, FRAMES):
        dead[frame] &= 1 - dead[frame - 1]
    rests = measure_photon_noise(open_recording(written(tmp_path / "dead.dat", dead)))
    assert rests.afterpulsing == pytest.approx(-1, abs=0.01) and rests.windows[2].variance < 0.8
    once = coins(3, 0.2)
    again = once | np.concatenate([once[:1], once[:-1]]) & coins(4, 0.1)
    assert measure_photon_noise(open_recording(written(tmp_path / "after.dat", again))).afterpulsing > 0.2
    beside = once.copy()
    beside[:, :, 1:] |= once[:, :, :-1] & coins(5, 0.1)[:, :, 1:]
    report = measure_photon_noise(open_recording(written(tmp_path / "beside.dat", beside)))
    assert report.crosstalk > 0.2 and abs(report.afterpulsing) < 0.02


def test_the_command_takes_the_response_from_sidecar_or_option(tmp_path: Path) -> None:
    cube, spikes = written(tmp_path / "cube.dat", coins(6)), replace(SENSOR, response=Response.INTEGRATE_AND_FIRE)
    plain = written(tmp_path / "plain.dat", coins(6), spikes)
    said = []
    for words in ([str(cube)], [str(plain), "--response", "bernoulli"]):
        done = CliRunner().invoke(app, ["noise-report", *words, "--json", str(tmp_path / "noise.json")])
        assert done.exit_code == 0, done.output
        said.append(done.output.splitlines()[-8:])
    assert said[0] == said[1] and "photons a pixel and frame" in said[0][0]
    assert json.loads((tmp_path / "noise.json").read_text())["flux"] == pytest.approx(0.357, abs=0.01)


@pytest.mark.parametrize(("p", "words"), [(0.0, "no pixel fires"), (1.0, "no pixel fires")])
def test_what_says_no_flux_is_told(tmp_path: Path, p: float, words: str) -> None:
    recording = open_recording(written(tmp_path / "flat.dat", coins(7, p)))
    with pytest.raises(RecordingError, match=words):
        measure_photon_noise(recording)
    short = open_recording(written(tmp_path / "short.dat", coins(8)[:60]))
    with pytest.raises(RecordingError, match="too few"):
        measure_photon_noise(short)
