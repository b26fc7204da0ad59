"""`spiked bench` measures what it states; no figure has a bound here."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from spiked_service.cli.bench import files, sustained, tracking
from spiked_service.cli.bench.growth import peak_bytes
from spiked_service.cli.bench.report import Machine, document, text
from spiked_service.cli.main import app
from typer.testing import CliRunner

from spiked.errors import ConfigurationError
from spiked.measurement import Measurement
from spiked.render import benchmark as renderer
from spiked.ring import RingError
from spiked.sensor import Sensor
from spiked.simulate import MotionKind, SimulatedCamera
from spiked.simulate.record import simulate


def test_files_are_written_and_decoded(tmp_path: Path) -> None:
    rows = files.rows(tmp_path, megabytes=2)
    assert [row.ratio is not None and row.ratio > 0 for row in rows] == [True] * 3
    assert not list(tmp_path.iterdir())


def test_a_stream_is_accounted_for_frame_by_frame(tmp_path: Path) -> None:
    outcome = sustained.run(Sensor(64, 40, 2000.0), 0.5, record=tmp_path)
    assert outcome.frames == 1000
    assert set(outcome.lost) == {"windows", "recorder"}
    assert set(outcome.consumer_shares) == {"windows", "recorder", "preview"}
    assert all(0 <= lost <= outcome.frames for lost in outcome.lost.values())
    assert not list(tmp_path.iterdir())


def test_a_consumer_that_dies_is_an_error(tmp_path: Path) -> None:
    with pytest.raises((RingError, OSError)):
        sustained.run(Sensor(64, 40, 2000.0), 0.2, record=tmp_path / "missing")


def test_tracking_has_its_speed_beside_its_error(tmp_path: Path) -> None:
    sensor = Sensor(240, 160, 20_000.0)
    simulate(SimulatedCamera(sensor, 0, MotionKind.ARC), tmp_path / "room", "room", 768, views=0)
    (row,) = tracking.rows(tmp_path / "room", (tracking.Setting(16, 4_000, 0.12, 768),))
    assert row.value > 100 and row.ratio == pytest.approx(row.value / 4_000)
    assert re.search(r"ATE \d+\.\d+ %; \d+ frames/s with the first map", row.against)
    assert row.target == ">= 4000"


def test_tracking_wants_one_recording_in_a_folder(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="0 recordings"):
        tracking.rows(tmp_path)


def test_rows_as_text_and_as_a_document() -> None:
    machine = Machine("a processor", 2, "a system", 0.1, 1e11, 1e10)
    rows = [Measurement("work", 1.5, "ms", 0.6, "of peak", ">= 0.55", 0.02, 2), Measurement("more", 3, "GB/s")]
    lines = text(machine, rows)
    assert "a processor" in lines[0]
    assert "0.6 of peak" in lines[1]
    assert "[>= 0.55]" in lines[1]
    assert json.loads(json.dumps(document(machine, rows)))["rows"][0]["ratio"] == 0.6


def test_growth_is_fitted() -> None:
    law = renderer.Scaling("cubes", [1.0, 10.0, 100.0], [2.0, 2e3, 2e6])
    assert law.exponent == pytest.approx(3)


def test_memory_is_that_of_the_step_and_not_of_who_asks() -> None:
    held = np.ones(1 << 29, np.uint8)
    small, large = peak_bytes(1_000), peak_bytes(100_000)
    assert small < held.nbytes  # where getrusage is asked, a process begins with the peak of its parent
    assert 14 * 4 * 99_000 < large - small < 5_000 * 99_000  # at least its parameters


def test_the_command_explains_itself() -> None:
    shown = CliRunner().invoke(app, ["bench", "--help"], env={"COLUMNS": "200"})
    assert shown.exit_code == 0
    assert "--json" in shown.output
