"""Waiting for what another process or thread will do."""

import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

PATIENCE_S = 240.0
"""What takes seconds may take minutes beside other tests."""

_T = TypeVar("_T")


def until(condition: Callable[[], _T], what: str, patience_s: float = PATIENCE_S, pause_s: float = 0.05) -> _T:
    """Ask again and again until the answer is true, and return it; the test fails if it is not in time."""
    deadline = time.monotonic() + patience_s
    while not (found := condition()):
        assert time.monotonic() < deadline, f"not so within {patience_s:g} s: {what}"
        time.sleep(pause_s)
    return found


@contextmanager
def meanwhile(work: Callable[[], object]) -> Iterator[None]:
    """Call `work` again and again on another thread; what it raises ends the test."""
    over = threading.Event()

    def repeat() -> None:
        while not over.is_set():
            work()

    with ThreadPoolExecutor(1) as thread:
        repeated = thread.submit(repeat)
        try:
            yield
        finally:
            over.set()
    repeated.result()
