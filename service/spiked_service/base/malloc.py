"""How a process of the service keeps memory: by itself glibc's malloc returns little of what was freed."""

import ctypes
import os

_M_ARENA_MAX = -8
"""Of glibc's malloc.h."""
ARENAS = 2
"""Heaps of the service's own process."""


def limit_arenas() -> None:
    """Let all threads share two of malloc's heaps; to be called before there are threads.

    By itself glibc gives threads up to eight heaps a core. Requests run on whatever thread is free, so that each heap
    comes to hold what was once needed for a picture or a scene, and keeps it: 31 MiB that nobody uses after six minutes
    of eight clients that look at views. Nothing happens where malloc is another, or MALLOC_ARENA_MAX says how many.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None and "MALLOC_ARENA_MAX" not in os.environ:
        mallopt(_M_ARENA_MAX, ARENAS)


def return_freed() -> None:
    """Give the pages that hold nothing back to the system; they are zeroed when they are needed again.

    By itself glibc keeps blocks of up to 32 MiB in its heaps, and what is freed there stays as long as anything behind
    it is in use. Every two seconds of a reconstruction of 1000 x 1000 pixels this takes 5 ms, and 2 % of the CPU time
    with the pages that are needed again; mapping each block of 1 MiB by itself (MALLOC_MMAP_THRESHOLD_) took 20 %. A
    heap is locked meanwhile. Nothing happens where malloc is another.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(ctypes.c_size_t(0))
