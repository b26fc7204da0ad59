"""The command line as its users meet it: in a process of its own."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
import pytest

from spiked.scene import Scene
from spiked.trajectory import Trajectory


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
    bare = tmp_path / "bare"
    bare.mkdir()
    for name in ("room.dat", "room.json", "groundtruth.tum"):
        (bare / name).symlink_to(room / name)
    held_out = json.loads((room / "views.json").read_text()) | {"views": []}
    (bare / "views.json").write_text(json.dumps(held_out))
    scored = run("evaluate", tmp_path, "--recording", bare / "room.dat")
    assert scored.returncode == 0 and scored.stderr == "", scored.stderr
    assert "ate_percent" in scored.stdout and "psnr" not in scored.stdout


def test_a_recording_without_a_path_in_it_says_why_and_exits_with_1(tmp_path: Path) -> None:
    noise = tmp_path / "noise.dat"
    noise.write_bytes(np.random.default_rng(0).bytes(12_500 * 128))
    done = run("reconstruct", noise, "-o", tmp_path / "out", "--width", "400", "--height", "250", "--fov", "60")
    assert done.returncode == 1
    assert "no pose was found: " in done.stderr
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["state"] == "boot"
    assert report["reason"]
    assert (tmp_path / "out" / "overview.png").stat().st_size > 0


def test_ctrl_c_keeps_what_there_is(room: Path, tmp_path: Path) -> None:
    arguments = ("reconstruct", room / "room.dat", "-o", tmp_path / "out", "--poses", room / "groundtruth.tum")
    with subprocess.Popen(command(*arguments, "--steps", "1000000"), stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        for line in process.stderr:
            if line.startswith("refining"):
                break
        process.send_signal(signal.SIGINT)
        told = process.stderr.read()
    assert process.returncode == 130, told
    assert len(Trajectory.read_tum(tmp_path / "out" / "trajectory.tum")) > 480
    assert len(Scene.read_ply(tmp_path / "out" / "scene.ply")) > 100


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
        done = run("serve", "--port", str(taken.getsockname()[1]), "--runtime", tmp_path / "runtime")
    assert done.returncode == 2
    assert done.stderr.startswith("error: cannot listen at 127.0.0.1:")
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "runtime").exists()
