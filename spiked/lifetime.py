"""Processes that end with the one that started them, also when that is killed and can end nobody."""

import ctypes
import os
import signal
from collections.abc import Callable

__all__ = ["end_with", "ending_with_this"]

_LIBC = ctypes.CDLL(None)
_PR_SET_PDEATHSIG = 1
"""Of prctl(2)."""


def end_with(parent: int) -> None:
    """Have the kernel kill this process when its parent, the process `parent`, has ended; at once if it has already."""
    _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os.kill(os.getpid(), signal.SIGKILL)


def ending_with_this() -> Callable[[], None]:
    """For `preexec_fn` of subprocess: the child is killed when the thread that starts it has ended."""
    parent = os.getpid()
    return lambda: end_with(parent)
