"""`spiked compare`: tables of real runs; a killed one goes on, and a failed cell is a row that says why."""

import csv
import io
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from spiked_service.cli.command_table import PANELS
from spiked_service.cli.comparison.cells import RECORD, Cell, Outcome, stored
from spiked_service.cli.comparison.page import page
from spiked_service.cli.comparison.rows import GROUPS, Row, chosen, rows
from spiked_service.cli.comparison.tables import COLUMNS, csv_text, markdown
from spiked_service.cli.main import app
from typer.testing import CliRunner

from spiked.errors import ConfigurationError
from spiked.recording import RecordingWriter
from spiked.sensor import Intrinsics, Sensor
from spiked.simulate import SimulatedCamera
from spiked.simulate.record import simulate

QUICK = ("--row", "quick=reconstruct --poses {truth} --steps 10", "--row", "none=reconstruct --window-frames 300")
LIGHT = ("--row", "light=baseline --poses given --map none")
PATIENCE_S = 120.0


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    sensor = Sensor(128, 80, 20_000.0, intrinsics=Intrinsics.from_fov(128, 80, 60))
    return simulate(SimulatedCamera(sensor), tmp_path_factory.mktemp("room") / "room", "room", 160, views=2)


def compare(*arguments: str | Path) -> tuple[int, str]:
    done = CliRunner().invoke(app, ["compare", *map(str, arguments)])
    return done.exit_code, done.output


def made_at(out: Path) -> dict[str, int]:
    """When each cell was made."""
    return {str(path.parent.relative_to(out)): path.stat().st_mtime_ns for path in out.rglob(RECORD)}


def test_a_table_is_made_once_and_a_failed_cell_is_a_row(room: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    code, said = compare(room, "-o", out, "--methods", "", *QUICK)
    assert code == 1 and "none, seed 0: failed" in said and "2 cells, 1 failed" in said
    (quick, none) = csv.DictReader(io.StringIO((out / "comparison.csv").read_text()))
    assert quick["method"] == "quick" and float(quick["ate_percent"]) < 1 and float(quick["psnr_db"]) > 10
    assert float(quick["lpips"]) > 0 and float(quick["cpu_s"]) > 0 and float(quick["peak_gib"]) > 0.05
    assert quick["command"] == "reconstruct --poses {truth} --steps 10 --seed 0"
    assert "--window-frames" in none["failed"] and "256" in none["failed"] and none["psnr_db"] == ""
    table = (out / "comparison.md").read_text()
    assert f"| quick | {float(quick['coverage']):.2f} |" in table and "AlexNet" in table
    text = (out / "comparison.html").read_text()
    assert text.count("data:image/webp;base64,") == 2 * 4 and "held-out view" in text
    assert not re.search(r"(?:src|href)=\"(?!data:)", text)
    before = made_at(out)
    assert compare(room, "-o", out, "--methods", "", *QUICK)[0] == 1
    assert made_at(out) == before
    assert compare(room, "-o", out, "--methods", "", *QUICK, "--retry")[0] == 1
    again = made_at(out)
    assert [name for name in before if again[name] != before[name]] == ["cells/room/none/seed-0"]


def test_a_killed_comparison_goes_on(room: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    words = ["compare", str(room), "-o", str(out), "--methods", "", *LIGHT, "--seeds", "2"]
    process = subprocess.Popen([sys.executable, "-m", "spiked_service", *words], stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + PATIENCE_S
    while not list(out.glob("cells/room/light/seed-1.making-*")):
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()
    first = made_at(out)
    assert list(first) == ["cells/room/light/seed-0"]
    code, said = compare(*words[1:])
    assert code == 0 and "seed 0: kept" in said and "2 cells, 0 failed" in said
    second = made_at(out)
    assert second["cells/room/light/seed-0"] == first["cells/room/light/seed-0"] and len(second) == 2
    assert not list(out.rglob("*.making-*"))
    assert re.search(r"\| light \|.*\(\d+\.\d+-\d+\.\d+\)", (out / "comparison.md").read_text())


def test_cells_of_other_recordings_and_torn_cells_are_not_kept(room: Path, tmp_path: Path) -> None:
    beside = tmp_path / "beside"
    shutil.copytree(room.parent, beside)
    recording, out = beside / room.name, tmp_path / "out"
    compare(recording, "-o", out, "--methods", "", *QUICK[2:])
    cell = Cell(recording, "room", Row.parsed(QUICK[3]), 0)
    first, record = stored(cell, out), out / cell.place / RECORD
    assert first is not None and first.reason is not None
    assert stored(replace(cell, recording=room), out) == first, "the same content elsewhere"
    for changed in (recording, beside / "groundtruth.tum", beside / "views" / "00.png"):
        before = changed.read_bytes()
        changed.write_bytes(bytes(64) + before[64:])
        assert stored(cell, out) is None
        changed.write_bytes(before)
        assert stored(cell, out) == first
    whole = record.read_text()
    for torn in (whole[:-9], "", "null", whole.replace('"recording": "room"', '"recording": "other"')):
        record.write_text(torn)
        assert stored(cell, out) is None
    assert "failed (kept)" not in compare(recording, "-o", out, "--methods", "", *QUICK[2:])[1]
    assert not list(out.rglob("*.making-*"))
    again = stored(cell, out)
    assert again is not None and again.inputs == first.inputs


def test_a_cell_that_takes_too_long_and_a_recording_without_truth_are_told(tmp_path: Path) -> None:
    sensor = Sensor(64, 48, 20_000.0)
    with RecordingWriter(tmp_path / "bare.dat", sensor) as writer:
        writer.append(np.random.default_rng(0).integers(0, 256, (64, sensor.frame_bytes), np.uint8))
    code, said = compare(tmp_path / "bare.dat", "-o", tmp_path / "out", "--methods", "given-spiked", "--limit", "1",
                         "--row", "slow=reconstruct --fov 60")  # fmt: skip
    assert code == 1
    assert "needs the true poses" in said and "it took more than 1 s" in said
    assert "observed" in (tmp_path / "out" / "comparison.html").read_text()


def test_two_comparisons_do_not_share_a_folder(room: Path, tmp_path: Path) -> None:
    import fcntl

    with (tmp_path / ".lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        with pytest.raises(ConfigurationError, match="another comparison"):
            app(["compare", str(room), "-o", str(tmp_path)], standalone_mode=False)


def test_every_named_row_is_a_command_that_exists() -> None:
    commands = {name for names in PANELS.values() for name in names}
    for row in rows().values():
        assert row.summary and row.arguments[0] in commands
        words = [word for word in row.arguments[1:] if word.startswith("--")]
        done = CliRunner().invoke(app, [row.arguments[0], "--help"], env={"COLUMNS": "300", "TERMINAL_WIDTH": "300"})
        assert all(f"{word} " in done.output for word in words), row
    assert len(rows()) == sum(len(group) for group in GROUPS.values())


@pytest.mark.parametrize(
    ("names", "own", "says"),
    [
        (["nobody"], [], "no such row"),
        ([], ["x=serve"], "reconstruct and baseline"),
        ([], ["../x=reconstruct"], "a name of letters"),
        ([], ["x=reconstruct 'open"], "No closing quotation"),
        (["spiked"], ["spiked=reconstruct"], "exists"),
        ([], [], "give --methods or --row"),
    ],
)
def test_rows_that_cannot_be_are_refused(names: list[str], own: list[str], says: str) -> None:
    with pytest.raises(ConfigurationError, match=says):
        chosen(names, own)


def test_groups_and_rows_are_taken_once() -> None:
    found = chosen(["baselines", "colmap-tfi", "spiked"], ["mine=baseline --images tfi --pictures 20"])
    assert [row.name for row in found] == ["colmap-tfp", "colmap-tfi", "colmap-charge", "spiked", "mine"]
    assert found[-1] == Row("mine", ("baseline", "--images", "tfi", "--pictures", "20"), "given by --row")


def test_hostile_names_and_reasons_are_escaped() -> None:
    bad = Outcome(recording="<b>|", row="r", seed=0, command=[], reason="<script>|x", seconds=1, cpu_s=1, peak_gib=1)
    assert "<script>" not in page([bad], {}, ["<i>"]) and "<b>" not in page([bad], {}, ["<i>"])
    assert "<script>\\|x" in markdown([bad])


def test_csv_gives_back_every_figure() -> None:
    rng = np.random.default_rng(0)
    figures = {column.key: float(rng.random()) for column in COLUMNS[:11]}
    known = {"recording": "a", "row": "b,c", "command": ["x"], "seconds": 0.1, "cpu_s": 1 / 3, "peak_gib": 2}
    made = [Outcome(seed=seed, figures=figures, **known) for seed in range(2)]
    for line, outcome in zip(csv.DictReader(io.StringIO(csv_text(made))), made, strict=True):
        assert (line["method"], int(line["seed"])) == (outcome.row, outcome.seed)
        assert {column.key: float(line[column.key]) for column in COLUMNS} == figures | {
            "seconds": 0.1, "cpu_s": 1 / 3, "peak_gib": 2,
        }  # fmt: skip


@pytest.mark.slow
def test_an_interruption_ends_the_method(room: Path, tmp_path: Path) -> None:
    words = ["compare", str(room), "-o", str(tmp_path / "out"), "--methods", "", *QUICK[:2]]
    process = subprocess.Popen([sys.executable, "-m", "spiked_service", *words], stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + PATIENCE_S
    while not (running := list(tmp_path.glob("out/cells/room/quick/*.making-*/output.txt"))):
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.02)
    time.sleep(0.5)  # Python loses an exception of a signal handler that runs while it forks
    process.send_signal(signal.SIGINT)
    assert process.wait(30) == 130
    found = subprocess.run(["pgrep", "-f", str(running[0].parent)], capture_output=True, text=True, check=False)
    assert os.getpid() not in map(int, found.stdout.split()) and found.stdout == ""
