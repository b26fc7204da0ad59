"""Identities of processes that differ even if the kernel reuses a process id."""

import os
from pathlib import Path

_PID_BITS = 22  # PID_MAX_LIMIT of the kernel is 2^22


def identity(pid: int) -> int | None:
    """Process id and start time (clock ticks since boot) in one uint64; None if there is no such living process.

    A zombie counts as dead. Process ids are those of the caller's pid namespace, so all processes of a ring must share
    one.
    """
    try:
        stat = Path(f"/proc/{pid}/stat").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return None
    # The second field is the command in brackets and may itself hold brackets and spaces; see proc_pid_stat(5).
    fields = stat.rpartition(")")[2].split()
    state, start_ticks = fields[0], int(fields[19])
    return None if state in "ZX" else start_ticks << _PID_BITS | pid


def own_identity() -> int:
    """`identity` of this process."""
    own = identity(os.getpid())
    assert own is not None, "a running process is alive"
    return own


def pid_of(owner: int) -> int:
    """The process id in an identity."""
    return owner & (1 << _PID_BITS) - 1


def is_alive(owner: int) -> bool:
    """Whether the process with this identity still runs."""
    return identity(pid_of(owner)) == owner
