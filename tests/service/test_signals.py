"""A command that is ended by a signal cleans up first, and ends by that signal; `nohup` keeps it."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from spiked_service.base.signals import cleaning_up, handling, holding, read_line
from waiting import until

WIZARD = (sys.executable, "-m", "spiked_service", "calibrate", "--device", "sim:?width=64&height=48&rate=1000", "-o")
"""Waits for a person, with a folder for its recordings."""


@contextmanager
def waiting_wizard(folder: Path, *before: str) -> Iterator[subprocess.Popen[bytes]]:
    command = [*before, *WIZARD, folder / "camera.npz"]
    # The tests may run with nohup themselves, or in the background of a shell, which ignores Ctrl-C.
    with handling({signal.SIGHUP: signal.SIG_DFL, signal.SIGINT: signal.SIG_DFL}):
        started = subprocess.Popen(command, stdin=subprocess.PIPE, cwd=folder)
    with started as wizard:
        until(lambda: bool(list(folder.glob(".spiked-*"))), "its folder")
        try:
            yield wizard
        finally:
            wizard.kill()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGINT])
def test_a_command_that_is_ended_removes_what_it_did_not_finish(number: signal.Signals, tmp_path: Path) -> None:
    with waiting_wizard(tmp_path) as wizard:
        wizard.send_signal(number)
        assert wizard.wait(60) == (130 if number is signal.SIGINT else -number)
    assert list(tmp_path.iterdir()) == []


def test_a_command_outlives_its_terminal_with_nohup(tmp_path: Path) -> None:
    with waiting_wizard(tmp_path, "nohup") as wizard:
        wizard.send_signal(signal.SIGHUP)
        wizard.send_signal(signal.SIGTERM)
        assert wizard.wait(60) == -signal.SIGTERM
    assert not list(tmp_path.glob(".spiked-*"))


INTERRUPTED = """
import os, signal, sys
from spiked_service.cli.program import main

class CtrlC:
    def find_spec(self, name, path=None, target=None):
        if name == MODULE:
            os.kill(os.getpid(), signal.SIGINT)

MODULE = sys.argv.pop()
signal.signal(signal.SIGINT, signal.default_int_handler)
sys.meta_path.insert(0, CtrlC())
main()
"""


@pytest.mark.parametrize(
    ("module", "code"),
    [
        pytest.param("typer", -signal.SIGINT, id="of the program"),
        pytest.param("numpy.linalg", 130, id="of the command"),
    ],
)
def test_ctrl_c_during_an_import_ends_a_command_without_a_traceback(module: str, code: int, tmp_path: Path) -> None:
    command = [sys.executable, "-c", INTERRUPTED, "verify", "recording.dat", module]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr.strip()) == (code, "")


READER = """
import os, signal, sys, threading
from spiked_service.base.signals import cleaning_up, read_line

def end() -> None:
    os.read(go, 1)
    signal.pthread_kill(threading.get_ident(), signal.SIGTERM)  # a read of the main thread is not interrupted by it

go = os.dup(0)
silent, kept = os.pipe()
threading.Thread(target=end, daemon=True).start()
with cleaning_up():
    print("ready", flush=True)
    read_line(silent)
"""


def test_a_signal_that_another_thread_took_ends_a_wait_for_a_line() -> None:
    with subprocess.Popen([sys.executable, "-c", READER], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as reader:
        assert reader.stdout is not None
        assert reader.stdin is not None
        assert reader.stdout.readline() == b"ready\n"
        reader.stdin.write(b"x")
        reader.stdin.flush()
        try:
            assert reader.wait(60) == -signal.SIGTERM
        finally:
            reader.kill()


def test_lines_are_read_one_by_one() -> None:
    end, start = os.pipe()
    os.write(start, "s\nä\nrest".encode())
    os.close(start)
    assert [read_line(end) for _ in range(4)] == ["s\n", "ä\n", "rest", ""]
    os.close(end)


def test_signals_wait_for_an_import_that_would_swallow_them() -> None:
    came: list[int] = []
    with handling({signal.SIGTERM: lambda number, frame: came.append(number)}):
        with holding():
            os.kill(os.getpid(), signal.SIGTERM)
            assert came == []
        assert came == [signal.SIGTERM]


def test_without_a_signal_nothing_ends() -> None:
    before = signal.getsignal(signal.SIGTERM)
    with cleaning_up():
        assert signal.getsignal(signal.SIGTERM) is not before
    assert signal.getsignal(signal.SIGTERM) is before
