"""The figures of recordings that not everybody has, on the built-in room, by the commands that anybody can run.

docs/validation.md says which figure stands for which.
"""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

pytestmark = pytest.mark.validation
Figure = Callable[[str, object, str], None]


def spiked(*arguments: str, cwd: Path) -> str:
    """What the command prints."""
    command = [sys.executable, "-m", "spiked_service", *arguments]
    return subprocess.run(command, cwd=cwd, check=True, capture_output=True, text=True).stdout


def score(room: tuple[str, ...], steps: int, cwd: Path) -> dict[str, float]:
    """A room simulated, reconstructed and evaluated."""
    spiked("simulate", "-o", "room", *room, cwd=cwd)
    spiked("reconstruct", "room/simulated.dat", "-o", "out", "--steps", str(steps), cwd=cwd)
    spiked("evaluate", "out", "--recording", "room/simulated.dat", "--json", "score.json", cwd=cwd)
    figures: dict[str, float] = json.loads((cwd / "score.json").read_text())
    return figures


def test_counts_of_a_simulated_camera_vary_less_than_any_binomial(tmp_path: Path, figure: Figure) -> None:
    """As on `static_fence.dat`, a clip of a real camera that stands still."""
    spiked("simulate", "-o", "still", "--motion", "stand_then_move", "--frames", "320", cwd=tmp_path)
    spiked("noise-report", "still/simulated.dat", "--json", "noise.json", cwd=tmp_path)
    report = json.loads((tmp_path / "noise.json").read_text())
    (row,) = (row for row in report["windows"] if row["frames"] == 32)
    figure("noise on a still room, 320 frames: var(count, n = 32)", f"{row['variance']:.3f}", "0.15 to 0.25")
    assert 0.15 < row["variance"] < 0.25
    assert row["charge"] < row["counted"] / 2


def test_a_slow_room_is_reconstructed(tmp_path: Path, figure: Figure) -> None:
    """As living and garden: grey, a tenth of a pixel a frame."""
    slow = ("--motion", "arc", "--width", "240", "--height", "160", "--frames", "640")
    found = score(slow, 500, tmp_path)
    told = f"{found['coverage']:.2f}; {found['ate_percent']:.3f} %; {found['psnr_db']:.1f} dB"
    figure("slow room: coverage; ATE; held-out PSNR", told, "1.00; < 0.5 %; > 30 dB")
    assert found["coverage"] >= 0.98 and found["ate_percent"] < 0.5 and found["psnr_db"] > 30


@pytest.mark.slow
def test_a_fast_room_in_colour_is_reconstructed(tmp_path: Path, figure: Figure) -> None:
    """As garden_fast and camp_color: a colour mosaic, five times as much motion a frame as the slow room."""
    fast = ("--motion", "arc", "--flow", "0.6", "--mosaic", "BGGR", "--rate", "40000", "--frames", "320")
    found = score(fast, 200, tmp_path)
    told = f"{found['coverage']:.2f}; {found['ate_percent']:.3f} %; {found['psnr_db']:.1f} dB"
    figure("fast room in colour: coverage; ATE; held-out PSNR", told, "1.00; < 1 %; > 28 dB")
    assert found["coverage"] >= 0.98 and found["ate_percent"] < 1 and found["psnr_db"] > 28
