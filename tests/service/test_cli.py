"""The command line as its users meet it: in a process of its own."""

import inspect
import io
import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import fields, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from rich.console import Console
from spiked_service.cli.commands.reconstruct import ProgressDisplay, reconstruct
from spiked_service.cli.commands.simulate import show_progress
from spiked_service.cli.dataset_runs.scores import notes
from spiked_service.settings.reconstruction_options import ReconstructionOptions

from spiked.recon import Options, State, Status
from spiked.recording import open_recording
from spiked.scene import Scene
from spiked.trajectory import Trajectory

from .survival import still_recording


def command(*arguments: str | Path) -> list[str]:
    return [sys.executable, "-m", "spiked_service", *map(str, arguments)]


def run(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command(*arguments), capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated recording of 512 frames, with its truth."""
    folder = tmp_path_factory.mktemp("simulated") / "room"
    done = run("simulate", "-o", folder, "--name", "room", "--frames", "512", "--width", "160", "--height", "96",
               "--views", "2", "--flow", "0.2")  # fmt: skip
    assert done.returncode == 0, done.stderr
    return folder


def test_no_module_is_imported_from_the_current_folder(tmp_path: Path) -> None:
    for name in ("typer", "rich", "uuid"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit('imported from the current folder')\n")
    unsafe = {name: value for name, value in os.environ.items() if name != "PYTHONSAFEPATH"}
    done = subprocess.run(command("version"), cwd=tmp_path, env=unsafe, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("spiked")


def test_a_full_disk_behind_the_output_ends_a_command_with_one_line() -> None:
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(command("version"), stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert (done.returncode, done.stderr) == (2, "error: the output cannot be written: the disk is full\n")


def test_info_says_what_a_recording_holds(room: Path) -> None:
    done = run("info", room / "room.dat")
    assert done.returncode == 0
    assert "160x96, from the sidecar room.json" in done.stdout
    assert "512 at 20000 Hz, 0.0256 s" in done.stdout


def test_verify_tells_a_good_recording_from_a_bad_one(room: Path, tmp_path: Path) -> None:
    assert run("verify", room / "room.dat").returncode == 0
    blank = tmp_path / "blank.dat"
    blank.write_bytes(bytes(12_500 * 10))
    done = run("verify", blank, "--width", "400", "--height", "250")
    assert done.returncode == 1
    assert "bad" in done.stdout


def test_the_same_seed_simulates_the_same_bytes(room: Path, tmp_path: Path) -> None:
    done = run("simulate", "-o", tmp_path / "again", "--name", "room", "--frames", "64", "--width", "160",
               "--height", "96", "--views", "0", "--flow", "0.2")  # fmt: skip
    assert done.returncode == 0, done.stderr
    again = (tmp_path / "again" / "room.dat").read_bytes()
    assert (room / "room.dat").read_bytes()[: len(again)] == again


def test_a_simulation_can_interpolate_and_states_the_error(tmp_path: Path) -> None:
    done = run("simulate", "-o", tmp_path / "walk", "--name", "walk", "--frames", "64", "--width", "160", "--height",
               "96", "--views", "1", "--picture-step", "0.5")  # fmt: skip
    assert done.returncode == 0, done.stderr
    stated = json.loads((tmp_path / "walk" / "walk.json").read_text())["simulation"]["interpolation"]
    assert stated["step_px"] == 0.5
    assert 0 < stated["rms_percent"] < 2


def test_a_simulation_says_how_long_it_takes_yet(capsys: pytest.CaptureFixture[str]) -> None:
    with show_progress("simulating", 4000, every_s=0) as show:
        show(1000)
    assert re.fullmatch(r"simulating: 1000/4000 frames, \d+ s left\n", capsys.readouterr().err)


def make_bad_input(folder: Path, kind: str) -> Path:
    path = folder / f"{kind}.dat"
    match kind:
        case "missing":
            pass
        case "empty":
            path.touch()
        case "odd":
            path.write_bytes(bytes(range(256)) * 7)
        case "folder":
            path.mkdir()
        case "png":
            cv2.imwrite(str(folder / "picture.png"), np.zeros((8, 8), np.uint8))
            (folder / "picture.png").rename(path)
        case "sidecar":
            path.write_bytes(bytes(12_500))
            path.with_suffix(".json").write_text("{")
    return path


@pytest.mark.parametrize("kind", ["missing", "empty", "odd", "folder", "png", "sidecar"])
def test_bad_input_is_one_line_and_exit_code_2_and_writes_nothing(tmp_path: Path, kind: str) -> None:
    path = make_bad_input(tmp_path, kind)
    before = sorted(tmp_path.iterdir())
    done = run("reconstruct", path, "-o", tmp_path / "out")
    assert done.returncode == 2
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1
    assert done.stdout == ""
    assert sorted(tmp_path.iterdir()) == before


def test_known_poses_without_optics_say_which_option_is_missing(room: Path, tmp_path: Path) -> None:
    path = tmp_path / "plain.dat"
    path.write_bytes(np.random.default_rng(0).bytes(12_500 * 16))
    size = ("--width", "400", "--height", "250")
    done = run("reconstruct", path, "-o", tmp_path / "out", *size, "--poses", room / "groundtruth.tum")
    assert done.returncode == 2
    assert "--fov" in done.stderr.splitlines()[-1]
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("white", [None, 0.12], ids=["of another program", "our own"])
def test_a_rendered_picture_shows_the_white_of_the_scene_as_white(tmp_path: Path, white: float | None) -> None:
    y, x = np.mgrid[-1.5:1.5:40j, -2:2:50j]
    values = np.linspace(0.1, 0.9, x.size, dtype=np.float32)[:, None] * np.float32(white or 1)
    ahead = np.stack([x.ravel(), y.ravel(), np.full(x.size, 2.0)], 1).astype(np.float32)
    turns, sizes = np.tile(np.float32([1, 0, 0, 0]), (x.size, 1)), np.full((x.size, 3), np.log(0.06), np.float32)
    scene = Scene(ahead, turns, sizes, np.full(x.size, 5, np.float32), values)
    scene.write_ply(tmp_path / "wall.ply", white)
    (tmp_path / "path.tum").write_text("0 0 0 0 0 0 0 1\n")
    files = (tmp_path / "wall.ply", "--poses", tmp_path / "path.tum", "--width", "120", "--height", "80")
    assert run("render", *files, "-o", tmp_path / "views").returncode == 0
    picture = cv2.imread(str(tmp_path / "views" / "000000.png"), cv2.IMREAD_GRAYSCALE)
    assert picture is not None
    assert (picture == 255).mean() < 0.01
    assert picture.mean() / 255 == pytest.approx(0.5, abs=0.05)
    assert run("render", *files, "-o", tmp_path / "bright", "--white", str(0.1 * (white or 1))).returncode == 0
    assert cv2.imread(str(tmp_path / "bright" / "000000.png"), cv2.IMREAD_GRAYSCALE).mean() > 240


def test_reconstruct_refuses_an_output_that_is_a_file(room: Path, tmp_path: Path) -> None:
    (tmp_path / "out").write_text("mine")
    done = run("reconstruct", room / "room.dat", "-o", tmp_path / "out")
    assert done.returncode == 2
    assert (tmp_path / "out").read_text() == "mine"


def test_reconstruct_with_known_poses_writes_all_results(room: Path, tmp_path: Path) -> None:
    done = run("reconstruct", room / "room.dat", "-o", tmp_path, "--poses", room / "groundtruth.tum", "--steps", "60")
    assert done.returncode == 0, done.stderr
    assert len(Trajectory.read_tum(tmp_path / "trajectory.tum")) > 480
    assert len(Scene.read_ply(tmp_path / "scene.ply")) > 100
    assert json.loads((tmp_path / "report.json").read_text())["frames"] == 512
    picture = cv2.imread(str(tmp_path / "overview.png"))
    assert picture is not None and picture.shape[1] > 1000 and picture.std() > 10
    scored = run("evaluate", tmp_path, "--recording", room / "room.dat", "--json", tmp_path / "score.json")
    assert scored.returncode == 0, scored.stderr
    figures = json.loads((tmp_path / "score.json").read_text())
    assert figures["ate_percent"] < 0.5
    assert figures["psnr_db"] > 20
    assert 10 < figures["worst_psnr_db"] < figures["psnr_db"]
    bare = tmp_path / "bare"
    bare.mkdir()
    for name in ("room.dat", "room.json", "groundtruth.tum"):
        (bare / name).symlink_to(room / name)
    held_out = json.loads((room / "views.json").read_text()) | {"views": []}
    (bare / "views.json").write_text(json.dumps(held_out))
    scored = run("evaluate", tmp_path, "--recording", bare / "room.dat")
    assert scored.returncode == 0 and scored.stderr == "", scored.stderr
    assert "ate_percent" in scored.stdout and "psnr" not in scored.stdout
    (bare / "views").symlink_to(room / "views")
    seen = json.loads((room / "views.json").read_text()) | {"held_out": False}
    (bare / "views.json").write_text(json.dumps(seen))
    scored = run("evaluate", tmp_path, "--recording", bare / "room.dat")
    assert scored.returncode == 0 and "made of the scored pictures" in scored.stderr and "psnr_db" in scored.stdout
    assert "made of" in notes(bare / "room.dat")[0] and notes(room / "room.dat") == []


def test_a_recording_without_a_path_in_it_says_why_and_exits_with_1(tmp_path: Path) -> None:
    noise = tmp_path / "noise.dat"
    noise.write_bytes(np.random.default_rng(0).bytes(12_500 * 128))
    done = run("reconstruct", noise, "-o", tmp_path / "out", "--width", "400", "--height", "250", "--fov", "60")
    assert done.returncode == 1
    assert done.stdout.endswith("0 poses for 128 frames, failed\n")
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert (report["state"], report["outcome"]) == ("boot", "failed")
    assert f"error: no path was found: {report['reason']}\n" in done.stderr
    assert (tmp_path / "out" / "overview.png").stat().st_size > 0


def test_a_recording_that_does_not_move_fails_and_its_picture_shows_what_the_camera_saw(tmp_path: Path) -> None:
    still = still_recording(tmp_path / "still.dat")
    done = run("reconstruct", still, "-o", tmp_path / "out")
    assert done.returncode == 1
    assert done.stdout.endswith("0 poses for 400 frames, failed\n")
    assert "error: no path was found: the camera stood still and nothing" in done.stderr
    recording = open_recording(still)
    seen = recording.images(0, 200).sum(0, dtype=float)
    overview = cv2.imread(str(tmp_path / "out" / "overview.png"), cv2.IMREAD_GRAYSCALE)
    assert overview is not None
    found = max(
        float(cv2.matchTemplate(overview, template, cv2.TM_CCOEFF_NORMED).max())
        for width in range(300, 420, 2)
        for template in [cv2.resize(np.uint8(255 * seen / seen.max()), (width, round(0.6 * width)))]
    )
    assert found > 0.8


def test_ctrl_c_keeps_what_there_is(room: Path, tmp_path: Path) -> None:
    arguments = ("reconstruct", room / "room.dat", "-o", tmp_path / "out", "--poses", room / "groundtruth.tum")
    with subprocess.Popen(command(*arguments, "--steps", "200000"), stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        for line in process.stderr:
            if line.startswith("refining"):
                break
        process.send_signal(signal.SIGINT)
        told = process.stderr.read()
    assert process.returncode == 130, told
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["outcome"] == "interrupted"
    assert any(warning.startswith("interrupted after 512 of 512 frames") for warning in report["warnings"])
    assert len(Trajectory.read_tum(tmp_path / "out" / "trajectory.tum")) > 480
    assert len(Scene.read_ply(tmp_path / "out" / "scene.ply")) > 100


def test_frames_that_the_time_did_not_reach_are_told(room: Path, tmp_path: Path) -> None:
    done = run("reconstruct", room / "room.dat", "-o", tmp_path / "out", "--seconds", "0.001")
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["frames"] < 512 and f"first {report['frames']} of 512 frames" in done.stdout
    assert any("of 512 frames, and the others are left out" in warning for warning in report["warnings"])
    assert report["outcome"] in ("cut short", "failed")


def test_ctrl_c_in_the_middle_of_a_line(room: Path, tmp_path: Path) -> None:
    end, stuffed = os.pipe()
    os.set_blocking(stuffed, False)
    with suppress(BlockingIOError):
        while True:
            os.write(stuffed, b"." * 4096)
    os.set_blocking(stuffed, True)
    with subprocess.Popen(command("reconstruct", room / "room.dat", "-o", tmp_path / "out"), stderr=stuffed) as process:
        os.close(stuffed)
        writes = re.compile(r"(1 0x2|64 0x2) ")  # the number of write on x86-64 and arm64, and the standard error
        deadline = time.monotonic() + 60
        while not writes.match(Path(f"/proc/{process.pid}/syscall").read_text()):
            assert time.monotonic() < deadline, "it never waits for its line to be read"
            time.sleep(0.02)
        process.send_signal(signal.SIGINT)
        with os.fdopen(end, errors="replace") as told:
            text = told.read()
    assert process.returncode == 130, text
    assert "stopping; writing what there is" in text


def test_a_service_beyond_loopback_needs_a_token() -> None:
    done = run("serve", "--host", "0.0.0.0", "--port", "0")
    assert done.returncode == 2
    assert "spiked token create" in done.stderr


def test_a_setting_that_has_a_flag_of_its_own_can_be_set_by_name_too() -> None:
    done = run("serve", "--set", "port=0", "--set", "log_level=inf")
    assert done.returncode == 2
    assert "did you mean info?" in done.stderr


def test_a_port_in_use_is_one_line(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        folders = ("--runtime", tmp_path / "runtime", "--data", tmp_path / "data")
        done = run("serve", "--port", str(taken.getsockname()[1]), *folders)
    assert done.returncode == 2
    assert done.stderr.startswith("error: cannot listen at 127.0.0.1:")
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "runtime").exists()


def test_command_line_http_and_library_have_one_table_of_options() -> None:
    described = ReconstructionOptions.model_json_schema()["properties"]
    declared = inspect.signature(reconstruct).parameters
    library = {one.name: getattr(Options(), one.name) for one in fields(Options)}
    library |= {"most_splats": Options().mapping.most_splats}
    # Options of cameras, and the budget, which is another one for a live reconstruction, have words of their own.
    for name in set(described) - {"intrinsics", "fov", "mosaic", "flipped", "seconds"}:
        (option,) = declared[name].annotation.__metadata__
        limits = described[name].get("anyOf", [described[name]])[0]
        assert declared[name].default == described[name]["default"] == library[name], name
        assert option.help == described[name]["description"]
        assert (option.min, option.max) == (limits.get("minimum"), limits.get("maximum")), name
    assert set(described) - set(declared) == set()
    assert set(library) - set(described) == {"poses", "calibration", "first_depth", "mapping"}


def shown(status: Status) -> list[str]:
    """The lines of the progress display at its end."""
    terminal = Console(file=io.StringIO(), force_terminal=True, width=80, color_system=None)
    with ProgressDisplay(1_000_000, terminal) as display:
        display.show(status)
    assert isinstance(terminal.file, io.StringIO)
    return re.split(r"[\r\n]+", re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", terminal.file.getvalue()))


def test_progress_fits_80_columns_with_a_bar_and_the_time_left() -> None:
    status = Status(State.DEGRADED, "its scale drifts", "refining", 1_000_000, 123_456, 1.2e-3, 1, 0.5, left_s=3700.0)
    lines = shown(status)
    assert max(map(len, lines)) <= 80
    bar = next(line for line in lines if line.startswith("refining"))
    assert bar.rstrip().endswith("1 h 2 min left") and "  0%" in bar
    assert "1000000/1000000 frames  degraded  loss 1.20e-03  123456 splats" in lines
    bar = next(line for line in shown(replace(status, stage="done")) if line.startswith("done"))
    assert bar.count("━") == 28 and bar.index("100%") >= 38


@pytest.mark.parametrize("arguments", [("-h",), ("--help",), ("reconstruct", "-h"), ("config", "show", "-h")])
def test_every_command_has_short_help(arguments: tuple[str, ...]) -> None:
    done = run(*arguments)
    assert done.returncode == 0 and "Usage: " in done.stdout and done.stderr == ""


def test_the_version_is_asked_for_in_the_usual_way() -> None:
    done = run("--version")
    assert done.returncode == 0
    assert done.stdout.startswith("spiked ") and done.stdout.split()[1] == run("version").stdout.split()[1]


def test_a_geometry_that_contradicts_the_sidecar_is_told_and_takes_its_optics_along(room: Path) -> None:
    done = run("verify", room / "room.dat", "--width", "320")
    assert done.returncode == 1
    assert "contradicts the sidecar: width 320 (not 160)" in done.stdout
    shown = run("info", room / "room.dat", "--width", "320")
    assert "optics     not known" in shown.stdout
    assert "the sidecar's optics are for 160x96" in shown.stderr
    assert "cx 80" in run("info", room / "room.dat", "--width", "160").stdout


@pytest.mark.parametrize("spelling", ["row_tagged", "row-tagged"])
def test_a_layout_is_understood_in_either_spelling(room: Path, tmp_path: Path, spelling: str) -> None:
    tagged = tmp_path / "tagged.dat"
    assert run("convert", room / "room.dat", tagged, "--to", spelling).returncode == 0
    assert json.loads(tagged.with_suffix(".json").read_text())["format"] == "row_tagged"
    again = tmp_path / "again.dat"
    assert run("convert", tagged, again, "--from", spelling).returncode == 0
    assert again.read_bytes() == (room / "room.dat").read_bytes()
    shown = run("info", tagged, "--layout", spelling)
    assert shown.returncode == 0 and "layout     row_tagged" in shown.stdout
    refused = run("info", tagged, "--layout", "tagged")
    assert refused.returncode == 2 and "'tagged' is not one of compact, row_tagged" in refused.stderr


@pytest.mark.parametrize(("option", "value"), [("--rate", "inf"), ("--intrinsics", "100,100,nan,10")])
def test_numbers_that_are_not_finite_are_refused(room: Path, tmp_path: Path, option: str, value: str) -> None:
    done = run("reconstruct", room / "room.dat", "-o", tmp_path / "out", option, value)
    assert done.returncode == 2 and done.stderr.startswith("error: ") and done.stderr.count("\n") <= 2
    assert not (tmp_path / "out").exists()
