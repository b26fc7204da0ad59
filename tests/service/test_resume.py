"""`spiked reconstruct --resume` after SIGKILL in each phase, after Ctrl-C, and where there is nothing to resume."""

import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest

KILLED = """
import os, signal, sys
from spiked.recon import checkpoint
from spiked.recon.odometry.odometry import Odometry
from spiked_service.cli.main import main

where, number = sys.argv[1].split(":")
left = int(number)
save = checkpoint.CheckpointSaver.save

def counted(self, reconstructor, now=False):
    global left
    save(self, reconstructor, now=True)
    left -= reconstructor.tracking_ended if where == "refining" else 1
    if left == 0 and where != "closures":
        os.kill(os.getpid(), signal.SIGKILL)

def killed(self, *given):
    os.kill(os.getpid(), signal.SIGKILL)

checkpoint.CheckpointSaver.save = counted
if where == "closures":
    Odometry.end = killed
sys.argv[:2] = ["spiked"]
main()
"""
"""The program, killed after a number of checkpoints in one phase, or when the tracking ends."""
RESULTS = "scene.ply", "trajectory.tum"


def run(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "spiked_service", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def kill(where: str, *arguments: str | Path) -> None:
    """Run the program until it is killed."""
    done = subprocess.run([sys.executable, "-c", KILLED, where, *map(str, arguments)], capture_output=True, check=False)
    assert done.returncode == -signal.SIGKILL, done.stderr


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("simulated") / "room"
    done = run("simulate", "-o", folder, "--name", "room", "--frames", "512", "--width", "160", "--height", "96",
               "--views", "0", "--flow", "0.2")  # fmt: skip
    assert done.returncode == 0, done.stderr
    return folder / "room.dat"


@pytest.fixture(scope="module")
def whole(room: Path) -> Path:
    """The results of a run that nothing interrupts."""
    done = run("reconstruct", room, "-o", room.parent / "whole", "--steps", "30", "--seed", "5")
    assert done.returncode == 0, done.stderr
    assert sorted(path.name for path in (room.parent / "whole").iterdir()) == sorted(
        ["overview.png", "report.json", *RESULTS]
    )
    return room.parent / "whole"


@pytest.mark.parametrize(
    "where",
    [
        "refining:12",
        *(
            pytest.param(one, marks=pytest.mark.slow)
            for one in ("tracking:1", "tracking:6", "closures:1", "refining:1", "refining:29")
        ),
    ],
)
def test_a_killed_run_goes_on_and_ends_with_the_same_files(room: Path, whole: Path, tmp_path: Path, where: str) -> None:
    kill(where, "reconstruct", room, "-o", tmp_path / "out", "--steps", "30", "--seed", "5")
    done = run("reconstruct", "--resume", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert done.stderr.startswith("resumed: ")
    for name in RESULTS:
        assert (tmp_path / "out" / name).read_bytes() == (whole / name).read_bytes()
    assert not (tmp_path / "out" / "checkpoint").exists()
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["options"]["steps"] == 30
    done = run("reconstruct", "--resume", tmp_path / "out")
    assert done.returncode == 2
    assert "has no checkpoint: the run there is over" in done.stderr


@pytest.fixture
def left(room: Path, tmp_path: Path) -> Path:
    kill("tracking:3", "reconstruct", room, "-o", tmp_path / "out", "--steps", "30", "--seed", "5")
    return tmp_path / "out"


def test_a_resumed_run_cannot_be_another_one(left: Path, room: Path, tmp_path: Path) -> None:
    other = room.parent / "other.dat"
    other.write_bytes(room.read_bytes()[::-1])
    other.with_suffix(".json").write_bytes(room.with_suffix(".json").read_bytes())
    for arguments, why in (
        (("--steps", "31"), "--steps 31: the interrupted run was begun with 30"),
        (("--fov", "50"), "--fov 50.0: the interrupted run was begun without it"),
        (("-o", tmp_path / "elsewhere"), "leave out --out"),
        ((other,), "it belongs to another recording"),
        ((tmp_path / "missing.dat",), "cannot be read"),
    ):
        done = run("reconstruct", *arguments, "--resume", left)
        assert done.returncode == 2, done.stderr
        assert why in done.stderr
        assert done.stderr.count("\n") == 1
    assert (left / "checkpoint" / "state").exists()


def test_a_damaged_checkpoint_is_told_and_kept(left: Path) -> None:
    state = left / "checkpoint" / "state"
    state.write_bytes(state.read_bytes()[:-1])
    done = run("reconstruct", "--resume", left)
    assert done.returncode == 2
    assert "its checkpoint is damaged" in done.stderr
    assert state.exists()


@pytest.mark.slow
def test_a_new_run_replaces_the_checkpoint_of_an_earlier_one(left: Path, room: Path) -> None:
    done = run("reconstruct", room, "-o", left, "--steps", "0")
    assert done.returncode == 0
    assert "begins anew" in done.stderr
    assert not (left / "checkpoint").exists()


@pytest.mark.slow
def test_ctrl_c_leaves_a_checkpoint_too(room: Path, whole: Path, tmp_path: Path) -> None:
    arguments = ["reconstruct", room, "-o", tmp_path / "out", "--steps", "30", "--seed", "5"]
    command = [sys.executable, "-m", "spiked_service", *map(str, arguments)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        process.stderr.readline()
        process.send_signal(signal.SIGINT)
        told = process.stderr.read()
    assert process.returncode == 130, told
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["outcome"] == ("interrupted" if report.get("poses") else "failed")
    assert report["warnings"][-1].startswith("interrupted after ")
    done = run("reconstruct", "--resume", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    for name in RESULTS:
        assert (tmp_path / "out" / name).read_bytes() == (whole / name).read_bytes()


def test_a_recording_or_a_run_to_resume_is_needed(room: Path) -> None:
    for arguments in ((), (room,), ("-o", "out")):
        done = run("reconstruct", *arguments)
        assert done.returncode == 2
        assert "or --resume OUT" in done.stderr
