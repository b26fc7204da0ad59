"""How the service's process keeps memory."""

import ctypes
import os

_M_ARENA_MAX = -8
"""Of glibc's malloc.h."""
ARENAS = 2
"""Heaps of the process."""


def limit_arenas() -> None:
    """Let all threads share two of malloc's heaps; to be called before there are threads.

    By itself glibc gives threads up to eight heaps a core. Requests run on whatever thread is free, so that each heap
    comes to hold what was once needed for a picture or a scene, and keeps it: 31 MiB that nobody uses after six minutes
    of eight clients that look at views. Nothing happens where malloc is another, or MALLOC_ARENA_MAX says how many.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None and "MALLOC_ARENA_MAX" not in os.environ:
        mallopt(_M_ARENA_MAX, ARENAS)
