"""Work of requests that waits for others."""

import os
import threading

import pytest
from spiked_service.base.priority import NICE, behind_others


def niceness() -> int:
    """Of this thread."""
    return os.getpriority(os.PRIO_PROCESS, 0)


def test_long_work_and_its_threads_are_nice_and_their_caller_is_not() -> None:
    before, found = niceness(), []

    def work() -> str:
        thread = threading.Thread(target=lambda: found.append(niceness()))
        thread.start()
        thread.join()
        found.append(niceness())
        return "done"

    assert behind_others(work) == "done"
    assert found == [min(before + NICE, 19)] * 2 and niceness() == before


def test_errors_come_through() -> None:
    with pytest.raises(KeyError):
        behind_others(lambda: {}["nothing"])
