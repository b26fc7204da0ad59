"""A command that is ended by a signal cleans up first, and ends by that signal; `nohup` keeps it."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from spiked_service.base.signals import cleaning_up, handling, holding
from waiting import until

WIZARD = (sys.executable, "-m", "spiked_service", "calibrate", "--device", "sim:?width=64&height=48&rate=1000", "-o")
"""Waits for a person, with a folder for its recordings."""


@contextmanager
def waiting_wizard(folder: Path, *before: str) -> Iterator[subprocess.Popen[bytes]]:
    command = [*before, *WIZARD, folder / "camera.npz"]
    earlier = signal.signal(signal.SIGHUP, signal.SIG_DFL)  # the tests may run with nohup themselves
    try:
        started = subprocess.Popen(command, stdin=subprocess.PIPE, cwd=folder)
    finally:
        signal.signal(signal.SIGHUP, earlier)
    with started as wizard:
        until(lambda: bool(list(folder.glob(".spiked-*"))), "its folder")
        yield wizard
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
