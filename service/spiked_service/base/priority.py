"""Long work that a request waits for, behind live captures and other requests."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

NICE = 10
"""Niceness that is added."""

_T = TypeVar("_T")


def behind_others(work: Callable[[], _T]) -> _T:
    """Its result. It runs on a thread of its own: Linux keeps niceness by thread, and nobody may lower it again.

    Threads that it starts have the niceness, too.
    """
    with ThreadPoolExecutor(1, "behind others", lambda: os.nice(NICE)) as thread:
        return thread.submit(work).result()
