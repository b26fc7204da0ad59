"""Work on another thread ends with its result or its error, when it is told to, and in copies."""

import os
import pickle
import subprocess
import sys
import threading
from collections.abc import Callable
from copy import deepcopy

import pytest

from spiked.recon.background import BEHIND_NICE, Background


def test_the_result_is_waited_for() -> None:
    go = threading.Event()
    work = Background(lambda stop: go.wait() and 7)
    assert not work.done
    go.set()
    assert work.result() == 7 and work.result() == 7
    assert work.done and deepcopy(work).done


def test_an_error_reaches_the_thread_that_waits() -> None:
    def fail(stop: Callable[[], bool]) -> None:
        raise ValueError("the path is torn")

    with pytest.raises(ValueError, match="torn"):
        Background(fail).result()


def test_it_ends_when_it_is_told() -> None:
    def until(stop: Callable[[], bool]) -> str:
        while not stop():
            pass
        return "ended"

    work = Background(until)
    work.stop()
    assert work.result() == "ended"


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere threads have the priority of their process")
def test_a_thread_behind_another_has_less_priority() -> None:
    def niceness(stop: Callable[[], bool]) -> int:
        return os.getpriority(os.PRIO_PROCESS, threading.get_native_id())

    own = os.getpriority(os.PRIO_PROCESS, threading.get_native_id())
    assert Background(niceness).result() == own
    assert Background(niceness, behind=True).result() == min(own + BEHIND_NICE, 19)
    assert os.getpriority(os.PRIO_PROCESS, threading.get_native_id()) == own


def test_copies_have_the_result_and_no_thread() -> None:
    work = Background(lambda stop: [1, 2])
    copy, stored = deepcopy(work), pickle.loads(pickle.dumps(work))
    assert copy.result() == stored.result() == [1, 2]
    assert deepcopy(copy).result() == [1, 2]


def test_it_does_not_keep_a_program_from_ending() -> None:
    program = """
from spiked.recon.background import Background

def work(stop):
    while not stop():
        pass
    print("told to end")

Background(work)
raise SystemExit(3)
"""
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False)
    assert (ended.returncode, ended.stdout, ended.stderr) == (3, "told to end\n", "")
