"""The promise of the README on recordings of real places, scored by a program that knows nothing of this one."""

import json
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "least_psnr_db", "most_ate_percent"),
    [("living", 36.0, 0.15), ("garden", 29.5, 0.2), ("garden_fast", 26.8, 0.3), ("camp_color", 29.2, 0.1)],
)
def test_streams_reach_the_promised_figures(
    shared: Path, tmp_path: Path, name: str, least_psnr_db: float, most_ate_percent: float
) -> None:
    stream, figures = shared / "streams" / name, tmp_path / "score.json"
    command = [sys.executable, "-m", "spiked_service", "reconstruct", str(stream / f"{name}.dat"), "-o", str(tmp_path)]
    subprocess.run(command, check=True, capture_output=True)
    files = [str(tmp_path / "trajectory.tum"), str(tmp_path / "scene.ply")]
    script = str(shared / "score" / "score.py")
    subprocess.run(
        [sys.executable, script, str(stream), *files, "--json", str(figures)], check=True, capture_output=True
    )
    score = json.loads(figures.read_text())
    assert score["coverage"] >= 0.98
    assert score["ate_percent"] <= most_ate_percent
    assert score["psnr"] >= least_psnr_db
