"""Real-time scheduling and locked memory for the acquisition process."""

import ctypes
import os
import resource
from pathlib import Path

PRIORITY = 20
"""SCHED_FIFO priority, 1 to 99: above all ordinary processes, below the kernel's interrupt threads (50)."""
_CAP_IPC_LOCK, _CAP_SYS_NICE = 14, 23
"""Numbers of linux/capability.h."""
_MCL_CURRENT, _MCL_FUTURE = 1, 2
"""Flags of mlockall, sys/mman.h."""


def take_priority() -> list[str]:
    """Schedule the calling thread in real time, lock the process's memory; a note for each that is not permitted."""
    return [note for note in (_schedule(), _lock_memory()) if note]


def may_schedule() -> bool:
    """Whether limits and capabilities of this process permit real-time priority."""
    _, hard = resource.getrlimit(resource.RLIMIT_RTPRIO)
    enough = hard == resource.RLIM_INFINITY or hard >= PRIORITY
    return enough or bool(_effective_capabilities() >> _CAP_SYS_NICE & 1)


def may_lock_memory() -> bool:
    """Whether this process may lock all of its present and future memory."""
    _, hard = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    return hard == resource.RLIM_INFINITY or bool(_effective_capabilities() >> _CAP_IPC_LOCK & 1)


def _schedule() -> str | None:
    try:
        # Child processes get ordinary scheduling.
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(PRIORITY))
    except OSError as error:
        return (
            f"acquisition runs without real-time priority ({error.strerror}): permit it with LimitRTPRIO={PRIORITY} in "
            f"the systemd unit, or `- rtprio {PRIORITY}` in /etc/security/limits.d"
        )
    return None


def _lock_memory() -> str | None:
    permit = "permit it with LimitMEMLOCK=infinity in the systemd unit, or `- memlock unlimited` in limits.d"
    # With a limit, a later allocation would fail. Without a lock it can be paged out instead.
    if not may_lock_memory():
        return f"acquisition's memory may be paged out (the limit of locked memory): {permit}"
    _, hard = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    resource.setrlimit(resource.RLIMIT_MEMLOCK, (hard, hard))
    if ctypes.CDLL(None, use_errno=True).mlockall(_MCL_CURRENT | _MCL_FUTURE):
        return f"acquisition's memory may be paged out ({os.strerror(ctypes.get_errno())}): {permit}"
    return None


def _effective_capabilities() -> int:
    """Effective capabilities of this process, bits as in capabilities(7)."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("CapEff:"):
            return int(line.split()[1], 16)
    return 0
